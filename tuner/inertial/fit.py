"""The lags of the motors and the gains from squared rotor speed to motion, by least squares.

In the band of `tuner.inertial.signals`, with Ω the rotor speeds that follow the commands::

    dω/dt = gain · Σ lever·Ω² + damping · ω + coupling · (ω × ω) + constant       about x, y, z
    f_z   = gain · ΣΩ² + decline · t·ΣΩ² + constant                              along z

about x and y with the moment of drag, which the accelerometer shows, less its mean over the flight,
and which acts at the height of the rotors, so that the constant is the steady moment of rotors that
differ and of a mass that is not in the middle; about z with the reaction of rotors that speed up.
Commands are known exactly, so that noise biases no gain. The gains are linear: for given lags their
best values are a solve, and the search moves three numbers (variable projection, Golub and Pereyra
1973). After Eschmann, Albani and Loianno, "Data-Driven System Identification of Quadrotors Subject
to Motor Delays", 2024, who take the lag for symmetric.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy import optimize

from sim_jax.vehicle import Motor
from tuner.core.numerics import Inverse
from tuner.inertial.signals import Lags, Stretch, blocks_of, derivative, rotor_speeds, smoothed
from tuner.recordings.flight import Array

OUTPUTS = ("roll", "pitch", "yaw", "thrust")
"""What is explained: three angular accelerations in rad/s², the specific force along z in m/s²."""
STEADY = ("steady_roll", "steady_pitch", "steady_yaw")
"""The constants of the first three, in rad/s²."""
CONSTANT = 3
"""The column of a constant among the regressors of an angular acceleration."""
TAUS = (0.01, 0.02, 0.04, 0.07, 0.12)
LATENCIES = (0.0, 0.01, 0.02)
"""s from which the search sets out; the likeliest of their pairs."""
BOUNDS = ((np.log(0.002), np.log(0.5)), (np.log(0.002), np.log(0.5)), (0.0, 0.06))
RESOLVED = 1e-4
"""rad/s² and m/s² that no gyro or accelerometer resolves: a simulated log may hold no noise, and
turn about no axis that it is not sent about."""
NUDGE = (1e-3, 1e-3, 1e-5)
"""Steps of the lags' coordinates for derivatives."""


@dataclass(frozen=True)
class Response:
    """What one flight says.

    Attributes
    ----------
    lags
        Of the motors.
    gains
        Output -> the response to squared rotor speed: of torque's lever in m, or of thrust.
    steady
        Of `STEADY` -> rad/s².
    names
        Of the numbers in ``covariance``: ``up``, ``down`` (logarithms), ``late`` (s), `OUTPUTS`
        (the gains), `STEADY`.
    covariance
        (10, 10) of those, of blocks rather than samples: residuals are alike from one to the next.
    explained
        Output -> share of its variance that is explained.
    curves
        Output -> measured and modelled (n,), for a picture.
    time
        (n,) s of those.
    """

    lags: Lags
    gains: Mapping[str, float]
    steady: Mapping[str, float]
    names: tuple[str, ...]
    covariance: Array
    explained: Mapping[str, float]
    curves: Mapping[str, tuple[Array, Array]]
    time: Array


@dataclass(frozen=True)
class _Problem:
    """What is explained, and by what."""

    stretches: tuple[Stretch, ...]
    motor: Motor
    levers: Array
    measured: Mapping[str, Array]


def fit_response(stretches: tuple[Stretch, ...], motor: Motor, levers: Array) -> Response:
    """Fit the lags and the gains of one flight.

    Parameters
    ----------
    stretches
        Of the flight, at least one.
    motor
        The curve from command to rotor speed.
    levers
        (4, 3) m, moments of one newton of thrust at each rotor.
    """
    targets: dict[str, list[Array]] = {name: [] for name in OUTPUTS}
    for stretch in stretches:
        turning = derivative(stretch.body_rate, stretch.step)[stretch.inside]
        for axis, name in enumerate(OUTPUTS[:3]):
            targets[name].append(turning[:, axis])
        targets["thrust"].append(smoothed(stretch.force, stretch.step)[stretch.inside, 2])
    measured = {name: np.concatenate(parts) for name, parts in targets.items()}
    problem = _Problem(stretches, motor, levers, measured)

    def misfit(coordinates: Array) -> float:
        solved = _solved(problem, Lags.at(coordinates))
        squares = [float(np.mean(left * left)) for _, _, left in solved.values()]
        return float(np.log(np.add(squares, RESOLVED**2)).sum())

    starts = [Lags(tau, tau, late).coordinates for tau in TAUS for late in LATENCIES]
    best = min(starts, key=misfit)
    end = optimize.minimize(
        misfit,
        best,
        method="Nelder-Mead",
        bounds=BOUNDS,
        options={"xatol": 1e-3, "fatol": 1e-4, "maxfev": 150},
    )
    lags = Lags.at(end.x)
    solved = _solved(problem, lags)
    return Response(
        lags=lags,
        gains={name: float(solution[0]) for name, (_, solution, _) in solved.items()},
        steady={
            name: float(solved[output][1][CONSTANT])
            for name, output in zip(STEADY, OUTPUTS, strict=False)
        },
        names=("up", "down", "late", *OUTPUTS, *STEADY),
        covariance=_covariance(problem, lags, solved),
        explained={
            name: float(
                (np.var(measured[name]) - np.var(left)) / (np.var(measured[name]) + RESOLVED**2)
            )
            for name, (_, _, left) in solved.items()
        },
        curves={
            name: (measured[name], measured[name] - left) for name, (_, _, left) in solved.items()
        },
        time=np.concatenate([stretch.time[stretch.inside] for stretch in stretches]),
    )


Solved = dict[str, tuple[Array, Array, Array]]
"""Output -> regressors (n, p), solution (p,), residuals (n,)."""


def _solved(problem: _Problem, lags: Lags) -> Solved:
    """Return each output's best explanation for given lags."""
    parts = [
        _regressors(stretch, problem.motor, problem.levers, lags) for stretch in problem.stretches
    ]
    solved: Solved = {}
    for name in OUTPUTS:
        table = np.concatenate([part[name] for part in parts])
        size = np.sqrt((table * table).mean(axis=0)) + 1e-300
        solution = np.linalg.lstsq(table / size, problem.measured[name], rcond=None)[0] / size
        solved[name] = table, solution, problem.measured[name] - table @ solution
    return solved


def _regressors(stretch: Stretch, motor: Motor, levers: Array, lags: Lags) -> dict[str, Array]:
    """Return for each output the columns that explain it, the gain's first."""
    speed = rotor_speeds(stretch, motor, lags)
    inside, step = stretch.inside, stretch.step
    torque = smoothed(speed**2 @ levers, step)[inside]
    rates = stretch.body_rate
    damping = smoothed(rates, step)[inside]
    coupling = smoothed(
        np.column_stack([rates[:, b] * rates[:, c] for b, c in ((1, 2), (0, 2), (0, 1))]), step
    )[inside]
    one = np.ones(int(inside.sum()))
    columns = {
        name: np.column_stack([torque[:, axis], damping[:, axis], coupling[:, axis], one])
        for axis, name in enumerate(OUTPUTS[:3])
    }
    across = smoothed(stretch.force[:, :2], step)[inside]
    across = across - across.mean(axis=0)
    columns["roll"] = np.column_stack([columns["roll"], across[:, 1]])
    columns["pitch"] = np.column_stack([columns["pitch"], across[:, 0]])
    spins = np.sign(levers[:, 2])
    reaction = derivative(speed @ spins[:, None], step)[inside]
    columns["yaw"] = np.column_stack([columns["yaw"], reaction])
    lift = smoothed((speed**2).sum(axis=1, keepdims=True), step)[inside]
    since = (stretch.time - stretch.time.mean())[inside, None]
    columns["thrust"] = np.column_stack([lift, since * lift, one])
    return columns


def _covariance(problem: _Problem, lags: Lags, solved: Solved) -> Array:
    """Return the covariance of lags and gains from how blocks of residuals scatter (sandwich)."""
    here = lags.coordinates
    shifted: list[Solved] = []
    for place, nudge in enumerate(NUDGE):
        moved = here.copy()
        moved[place] += nudge
        shifted.append(_solved(problem, Lags.at(moved)))
    sizes = [solved[name][0].shape[1] for name in OUTPUTS]
    total, first = 3 + sum(sizes), 3
    blocks = blocks_of(problem.stretches)
    count = int(blocks.max()) + 1
    bread, meat = np.zeros((total, total)), np.zeros((count, total))
    firsts = []
    for name, size in zip(OUTPUTS, sizes, strict=True):
        table, solution, left = solved[name]
        scale = float(np.hypot(np.std(left), RESOLVED))
        slopes = [
            (moved[name][0] - table) @ solution / nudge
            for moved, nudge in zip(shifted, NUDGE, strict=True)
        ]
        columns = np.zeros((len(left), total))
        columns[:, :3] = np.column_stack(slopes)
        columns[:, first : first + size] = table
        columns /= scale
        bread += columns.T @ columns
        np.add.at(meat, blocks, columns * (left / scale)[:, None])
        firsts.append(first)
        first += size
    constants = [first + CONSTANT for first in firsts[: len(STEADY)]]
    return _sandwich(bread, meat, [0, 1, 2, *firsts, *constants])


def _sandwich(bread: Array, meat: Array, wanted: list[int]) -> Array:
    """Return the wanted part of G⁻¹ Σ sᵀs G⁻¹, with few blocks made up for.

    What no sample tells of has a variance beyond any other.
    """
    nothing = np.zeros_like(bread)
    inverse = Inverse.of(bread, nothing)
    count, size = meat.shape
    scattered = inverse.sandwiched(meat.T @ meat, nothing) * (count / max(1, count - size))
    return np.asarray((scattered + inverse.open)[np.ix_(wanted, wanted)])

"""The lags of the motors and the gains from rotor speeds to motion, by prediction error.

With Ω the rotor speeds that follow the commands, f the specific force and h the height of the
rotors over the centre of mass::

    dω/dt = gain · (f_z · Σ lever·Ω² / ΣΩ² + h · (-f_y, f_x)) + damping · ω + coupling · (ω × ω)
            + drag · (f_y, f_x) + offset · (f_z - g) + constant                    about x and y
    dω/dt = gain · Σ lever·Ω² + reaction · dΣ±Ω/dt + spread · (x̄ · f_y - ȳ · f_x)
            + damping · ω + coupling · (ω × ω) + constant                          about z
    f_z   = gain · ΣΩ² + decline · t·ΣΩ² + constant                               along z

The accelerometer shows the effects of airspeed. f_z has the rotors' thrust after losses by battery
and inflow, which the rotors share for the moments about x and y. f_x and f_y have the rotors' drag,
which acts at their height; other effects of airspeed (flapping, drag of the body) are proportional
to it, within their prior. About z the rotors' drags act at the mean position of the rotors,
weighted by speed (x̄, ȳ).

Residuals are correlated, and the loop's rotors respond to them. Therefore prediction errors with an
autoregressive noise model are minimised (Ljung, System Identification, 13.4). The gains are linear:
they are solved for given lags, and the search moves three numbers (variable projection, Golub and
Pereyra 1973). After Eschmann, Albani and Loianno, "Data-Driven System Identification of Quadrotors
Subject to Motor Delays", 2024, who have one lag for both directions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg, optimize, signal

from sim_jax.constants import GRAVITY
from sim_jax.vehicle import Motor
from tuner.core.numerics import Array, Inverse, scaled_solve
from tuner.inertial.signals import Stretch, blocks_of, low_pass
from tuner.objective.rotor_response import MotorLags, rotor_speeds
from tuner.objective.rotor_signals import levers
from tuner.vehicle import ControllerFile, VehicleFile, values_of
from tuner.vehicle.model import model_of

OUTPUTS = ("roll", "pitch", "yaw", "thrust")
"""Three angular accelerations in rad/s², and the specific force along z in m/s²."""
STEADY = ("steady_roll", "steady_pitch", "steady_yaw")
"""The constants of the first three, in rad/s²."""
NUMBER_NAMES = ("up", "down", "late", *OUTPUTS, *STEADY)
"""The numbers of a `Response`: the lags' coordinates (`MotorLags`), gains, and constants."""
CONSTANT_COLUMN, RATE_COLUMN, DRAG_COLUMN = 0, 1, 3
"""The columns of a constant, of the rate, and about x and y of the drag, among those that no lag
moves."""
TRIM_SD = 0.1
"""rad/s². Steady accelerations differ by this between flights."""
MAX_AIRSPEED = 25.0
"""m/s along its axis at which a rotor has no thrust, at the latest."""
NOISE_MEMORY_S = 0.15
"""The autoregressive model predicts an error from so long before."""
GYRO_NOISE, ACCELEROMETER_NOISE = 1e-4, 0.02
"""rad/s and m/s² of white noise of any sensor: a simulated log may have none."""
BIAS_SD = 0.1
"""m/s², of the accelerometer along z."""
THRUST_BAND_HZ = 3.0
"""Up to this frequency the accelerometer measures the rotors' thrust,"""
DRAG_BAND_HZ = 8.0
"""and up to this one their drag."""
DRAG_HEIGHT_SD = 0.3
"""In arms, of the height at which forces of airspeed act."""
DRAG_MOMENT_ERROR = 0.02
"""Relative error of moments of drag from the accelerometer."""
MAX_PHASE_LAG_S = 0.02
"""A phase error is at most that of a rotor's lag."""
CENTRE_OFFSET_SD = 0.03
"""In arms, of the centre of mass across the rotors' axes."""
START_LAG_RATIOS = (0.5, 1.0, 2.0, 4.0)
"""The search starts from the best pair of these time constants, over the vehicle file's,"""
START_LATENCIES_S = (0.002, 0.012)
"""and these latencies."""
LAG_PRIOR_SD = np.array([0.7, 0.7, 0.01])
"""Of the lags' coordinates about the vehicle file's."""
LAG_BOUNDS = ((np.log(0.002), np.log(0.5)), (np.log(0.002), np.log(0.5)), (0.0, 0.06))
FIRST_STEPS = np.diag([0.2, 0.2, 0.003])
"""Of the simplex of the search."""
DERIVATIVE_STEPS = (1e-2, 1e-2, 2e-4)
"""Of the lags' coordinates."""
MAX_ROUNDS, LAG_TOLERANCE = 5, np.array([0.02, 0.02, 5e-4])
"""Rounds of whitening and search; smaller steps of the lags' coordinates have converged."""


@dataclass(frozen=True)
class Response:
    """The response of one flight.

    Attributes
    ----------
    values
        Of `NUMBER_NAMES`, in their order. An output's gain is mass over inertia in 1/m², of
        torque's lever in m, or of thrust to squared rotor speed; constants are in rad/s².
    covariance
        (10, 10) of them.
    explained
        Output -> explained share of its variance, in the band of `low_pass`.
    curves
        Output -> measured and modelled (n,) in that band, for a plot.
    time
        (n,) s of those.
    """

    values: Mapping[str, float]
    covariance: Array
    explained: Mapping[str, float]
    curves: Mapping[str, tuple[Array, Array]]
    time: Array

    @property
    def errors(self) -> dict[str, float]:
        """The numbers' standard errors."""
        return dict(zip(self.values, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))


TINY = 1e-30
"""Size of a zero column."""
RIDGE = 1e-12
"""Added to the unit diagonal of normal equations, against parallel columns."""
Tables = dict[str, list[Array]]
"""Output -> a table of each stretch."""


@dataclass(frozen=True)
class _Problem:
    """The regression problem.

    Attributes
    ----------
    stretches, vehicle, motor
        The flight and its vehicle, as far as it is known.
    measured
        Output -> (n,) of each stretch.
    fixed
        Output -> (n, k) of each stretch, regressors that do not depend on the lags; the constant
        first.
    shared
        (n, 3) m/s² of each stretch's all steps: f_x and f_y up to `DRAG_BAND_HZ`, f_z up to
        `THRUST_BAND_HZ`.
    """

    stretches: tuple[Stretch, ...]
    vehicle: VehicleFile
    motor: Motor
    measured: Tables
    fixed: Tables
    shared: tuple[Array, ...]

    @property
    def step(self) -> float:
        return self.stretches[0].step

    @property
    def start(self) -> Array:
        """The lags' coordinates (3,) in the vehicle file."""
        value = values_of(self.vehicle)
        late = value.get("actuator_latency") or 0.0
        return MotorLags(value["time_constant_up"], value["time_constant_down"], late).coordinates


@dataclass(frozen=True)
class _Whitening:
    """The whitening filter of one output's errors, and the projection on its fixed regressors.

    Attributes
    ----------
    kernel
        The filter, whose output has unit variance.
    prior
        (k,) information about the coefficients of fixed regressors.
    basis, target
        Orthonormal filtered fixed regressors (n + k, k), and the measured residual to them.
    """

    kernel: Array
    prior: Array
    basis: Array
    target: Array

    @staticmethod
    def of(problem: _Problem, name: str, kernel: Array, gain: float | None = None) -> _Whitening:
        """Return the whitening of an output; ``gain`` once it is estimated."""
        prior = _prior(problem, name, gain)
        table = np.vstack([_filter(problem.fixed[name], kernel), np.diag(np.sqrt(prior))])
        size = np.sqrt((table * table).sum(axis=0)) + TINY
        basis = np.linalg.qr(table / size)[0]
        target = np.concatenate([_filter(problem.measured[name], kernel), np.zeros(len(prior))])
        return _Whitening(kernel, prior, basis, target - basis @ (basis.T @ target))

    def residual(self, moving: Sequence[Array]) -> Array:
        """Return the residual (n + k,) to regressors that depend on the lags."""
        table = _filter(moving, self.kernel)
        table = np.vstack([table, np.zeros((len(self.prior), table.shape[1]))])
        table = table - self.basis @ (self.basis.T @ table)
        found = scaled_solve(table.T @ table, table.T @ self.target, RIDGE)
        return np.asarray(self.target - table @ found)

    def solve(
        self, columns: Sequence[Array], measured: Sequence[Array]
    ) -> tuple[Array, Array, Array]:
        """Return the best coefficients (k,), the filtered columns (n, k), and the errors (n,)."""
        table, seen = _filter(columns, self.kernel), _filter(measured, self.kernel)
        prior = np.zeros(table.shape[1])
        prior[-len(self.prior) :] = self.prior
        found = scaled_solve(table.T @ table + np.diag(prior), table.T @ seen, RIDGE)
        return found, table, seen - table @ found


def fit_response(stretches: tuple[Stretch, ...], vehicle: VehicleFile) -> Response:
    """Fit the lags and the gains of one flight.

    The covariance includes the difference to the fit at half the rate: effects of air, and of noise
    outside the loop, on a gain depend on frequency.

    Parameters
    ----------
    stretches
        At least one.
    vehicle
        Of a known mass, geometry, and curve from command to rotor speed.
    """
    found = _fit_once(stretches, vehicle)
    other = _fit_once(tuple(stretch.at_half_rate for stretch in stretches), vehicle)
    apart = np.subtract([*found.values.values()], [*other.values.values()])
    return replace(found, covariance=found.covariance + np.diag(apart**2))


def _fit_once(stretches: tuple[Stretch, ...], vehicle: VehicleFile) -> Response:
    problem = _problem_of(stretches, vehicle)
    weighings = {name: _Whitening.of(problem, name, np.ones(1)) for name in OUTPUTS}
    place = problem.start
    for _ in range(MAX_ROUNDS):
        weighings = _whitenings_at(problem, place, weighings)
    for number in range(MAX_ROUNDS):
        before, place = place, _search_lags(problem, place, weighings, first=number == 0)
        for _ in range(2):
            weighings = _whitenings_at(problem, place, weighings)
        if np.all(np.abs(place - before) < LAG_TOLERANCE):
            break
    return _response(problem, place, weighings)


def _problem_of(stretches: tuple[Stretch, ...], vehicle: VehicleFile) -> _Problem:
    measured: Tables = {name: [] for name in OUTPUTS}
    still: Tables = {name: [] for name in OUTPUTS}
    shared = []
    for stretch in stretches:
        inside, step = stretch.inside[:-1], stretch.step
        rate = stretch.body_rate[:-1]
        force = 0.5 * (stretch.force[1:] + stretch.force[:-1])
        turning = (np.diff(stretch.body_rate, axis=0) / step)[inside]
        across = low_pass(force[:, :2], step, DRAG_BAND_HZ)
        shared.append(np.column_stack([across, low_pass(force[:, 2:], step, THRUST_BAND_HZ)]))
        one = np.ones(int(inside.sum()))
        for axis, name in enumerate(OUTPUTS[:3]):
            coupling = rate[:, (axis + 1) % 3] * rate[:, (axis + 2) % 3]
            columns = [one, rate[inside, axis], coupling[inside]]
            if axis < 2:
                columns += [across[inside, 1 - axis], shared[-1][inside, 2] - GRAVITY]
            measured[name].append(turning[:, axis])
            still[name].append(np.column_stack(columns))
        measured["thrust"].append(force[inside, 2])
        still["thrust"].append(one[:, None])
    motor = model_of(vehicle, ControllerFile()).vehicle.motor
    return _Problem(stretches, vehicle, motor, measured, still, tuple(shared))


def _lag_columns(problem: _Problem, place: Array) -> Tables:
    """Return output -> regressors that depend on the lags, the gain's first."""
    vehicle, step = problem.vehicle, problem.step
    arms, places = levers(vehicle), _rotor_positions(vehicle)
    height = places[:, 2].mean()
    tables: Tables = {name: [] for name in OUTPUTS}
    for stretch, shared in zip(problem.stretches, problem.shared, strict=True):
        speed = rotor_speeds(stretch.command, step, problem.motor, MotorLags.at(place))
        inside = stretch.inside[:-1]
        square = 0.5 * (speed[1:] ** 2 + speed[:-1] ** 2)
        lift, torque = square.sum(axis=1), square @ arms
        each = shared[:, 2] / low_pass(lift[:, None], step, THRUST_BAND_HZ)[:, 0]
        mean = (speed[1:] + speed[:-1]) @ places / (speed[1:] + speed[:-1]).sum(axis=1)[:, None]
        spread = mean[:, 0] * shared[:, 1] - mean[:, 1] * shared[:, 0]
        reaction = np.diff(speed @ np.sign(arms[:, 2])) / step
        since = stretch.time[:-1] - stretch.time.mean()
        tables["roll"].append((each * torque[:, 0] - height * shared[:, 1])[inside, None])
        tables["pitch"].append((each * torque[:, 1] + height * shared[:, 0])[inside, None])
        tables["yaw"].append(np.column_stack([torque[:, 2], reaction, spread])[inside])
        tables["thrust"].append(np.column_stack([lift, since * lift])[inside])
    return tables


def _rotor_positions(vehicle: VehicleFile) -> Array:
    """Return (4, 3) m of the rotors from the centre of mass."""
    value, places = values_of(vehicle), np.array([rotor.position for rotor in vehicle.rotors])
    return np.asarray(places - [value.get(f"center_of_mass_{axis}") or 0.0 for axis in "xyz"])


def _prior(problem: _Problem, name: str, gain: float | None) -> Array:
    """Return the information (k,) about fixed regressors; ``gain`` once it is estimated."""
    prior = np.zeros(problem.fixed[name][0].shape[1])
    value = values_of(problem.vehicle)
    if name == "thrust":
        prior[CONSTANT_COLUMN] = BIAS_SD**-2
    elif name != "yaw":
        axis = OUTPUTS.index(name)
        if gain is None or gain <= 0.0:
            gain = value["mass"] / value[("inertia_xx", "inertia_yy")[axis]]
        arm = np.abs(levers(problem.vehicle)[:, axis]).max()
        prior[-2:] = (DRAG_HEIGHT_SD * arm * gain) ** -2, (CENTRE_OFFSET_SD * arm * gain) ** -2
    return prior


def _filter(tables: Sequence[Array], kernel: Array) -> Array:
    """Return the filtered rows (n, k) of all stretches, without the filter's first."""
    parts = [
        signal.lfilter(kernel, [1.0], table, axis=0)[len(kernel) - 1 :]
        for table in tables
        if len(table) >= len(kernel)
    ]
    return np.concatenate(parts)


def _columns(problem: _Problem, name: str, moving: Tables) -> list[Array]:
    pairs = zip(moving[name], problem.fixed[name], strict=True)
    return [np.hstack(pair) for pair in pairs]


def _whitenings_at(
    problem: _Problem, place: Array, weighings: Mapping[str, _Whitening]
) -> dict[str, _Whitening]:
    """Return the whitenings by the autocorrelation of errors at some lags."""
    moving, order = _lag_columns(problem, place), max(1, round(NOISE_MEMORY_S / problem.step))
    renewed = {}
    for name in OUTPUTS:
        columns, measured = _columns(problem, name, moving), problem.measured[name]
        found, *_ = weighings[name].solve(columns, measured)
        alike = np.zeros(order + 1)
        for table, values in zip(columns, measured, strict=True):
            errors = values - table @ found
            errors = errors - errors.mean()
            both = signal.correlate(errors, errors, "full", method="fft")
            alike += both[len(errors) - 1 :][: order + 1]
        alike /= sum(map(len, measured))
        if name == "thrust":
            alike[0] += ACCELEROMETER_NOISE**2
        else:
            alike[:2] += np.array([2.0, -1.0]) * (GYRO_NOISE / problem.step) ** 2
        ahead = linalg.solve_toeplitz(alike[:-1], alike[1:])
        new = np.sqrt(max(alike[0] - ahead @ alike[1:], 1e-300))
        kernel = np.concatenate([[1.0], -ahead]) / new
        renewed[name] = _Whitening.of(problem, name, kernel, float(found[0]))
    return renewed


def _search_lags(
    problem: _Problem, place: Array, weighings: Mapping[str, _Whitening], *, first: bool
) -> Array:
    """Return the most likely lags' coordinates (3,)."""
    begin = problem.start

    def misfit(at: Array) -> float:
        moving, total = _lag_columns(problem, at), float(np.sum(((at - begin) / LAG_PRIOR_SD) ** 2))
        for name in OUTPUTS:
            left = weighings[name].residual(moving[name])
            total += len(left) * float(np.log(np.mean(left * left) + TINY))
        return total

    if first:
        others = [
            np.array([*(begin[:2] + np.log(factor)), late])
            for factor in START_LAG_RATIOS
            for late in START_LATENCIES_S
        ]
        place = min([place, *others], key=misfit)
    end = optimize.minimize(
        misfit,
        place,
        method="Nelder-Mead",
        bounds=LAG_BOUNDS,
        options={
            "initial_simplex": np.vstack([place, place + FIRST_STEPS]),
            "xatol": 3e-3,
            "fatol": 0.1,
            "maxfev": 80,
        },
    )
    return np.asarray(end.x)


def _response(problem: _Problem, place: Array, weighings: Mapping[str, _Whitening]) -> Response:
    """Return the response at some lags, with its covariance."""
    moving, slopes = _lag_columns(problem, place), _slopes(problem, place)
    found, tables, errors, curves = {}, {}, {}, {}
    for name in OUTPUTS:
        weighing, columns = weighings[name], _columns(problem, name, moving)
        found[name], table, errors[name] = weighing.solve(columns, problem.measured[name])
        gains = found[name][: moving[name][0].shape[1]]
        by_lags = [_filter([part @ gains for part in s[name]], weighing.kernel) for s in slopes]
        tables[name] = np.column_stack([*by_lags, table])
        modelled = [table @ found[name] for table in columns]
        seen, made = (
            np.concatenate([low_pass(part[:, None], problem.step)[:, 0] for part in parts])
            for parts in (problem.measured[name], modelled)
        )
        curves[name] = seen, made
    covariance = _covariance(problem, weighings, tables, errors)
    covariance += _air_covariance(problem, moving, found)
    of_outputs = [solution[0] for solution in found.values()]
    constants = [found[n][moving[n][0].shape[1] + CONSTANT_COLUMN] for n in OUTPUTS[: len(STEADY)]]
    numbers = map(float, (*place, *of_outputs, *constants))
    return Response(
        values=dict(zip(NUMBER_NAMES, numbers, strict=True)),
        covariance=covariance,
        explained={
            name: float((np.var(seen) - np.var(seen - made)) / (np.var(seen) + BIAS_SD**2))
            for name, (seen, made) in curves.items()
        },
        curves=curves,
        time=np.concatenate([s.time[:-1][s.inside[:-1]] for s in problem.stretches]),
    )


def _slopes(problem: _Problem, place: Array) -> list[Tables]:
    """Return the derivatives of regressors by each of the lags' coordinates."""
    slopes = []
    for number, nudge in enumerate(DERIVATIVE_STEPS):
        ends = np.array([place, place])
        ends[:, number] = np.clip(
            place[number] + nudge * np.array([1.0, -1.0]), *LAG_BOUNDS[number]
        )
        span = ends[0, number] - ends[1, number]
        high, low = (_lag_columns(problem, end) for end in ends)
        slopes.append(
            {
                name: [(a - b) / span for a, b in zip(high[name], low[name], strict=True)]
                for name in OUTPUTS
            }
        )
    return slopes


def _covariance(
    problem: _Problem,
    weighings: Mapping[str, _Whitening],
    tables: Mapping[str, Array],
    errors: Mapping[str, Array],
) -> Array:
    """Return the covariance (10, 10): that of white errors, or a sandwich over blocks if larger."""
    order = len(weighings["roll"].kernel) - 1
    blocks = blocks_of(problem.stretches, order)
    total = 3 + sum(tables[name].shape[1] - 3 for name in OUTPUTS)
    bread, scores = np.zeros((total, total)), np.zeros((int(blocks.max()) + 1, total))
    bread[:3, :3] = np.diag(LAG_PRIOR_SD**-2)
    first, gains, constants = 3, [], []
    for name in OUTPUTS:
        table = tables[name]
        moved = table.shape[1] - 3 - len(weighings[name].prior)
        places = np.r_[0:3, first : first + table.shape[1] - 3]
        bread[np.ix_(places, places)] += table.T @ table
        still = places[3 + moved :]
        bread[still, still] += weighings[name].prior
        np.add.at(scores, (blocks[:, None], places[None]), table * errors[name][:, None])
        gains.append(first)
        constants.append(first + moved + CONSTANT_COLUMN)
        first += table.shape[1] - 3
    nothing = np.zeros_like(bread)
    inverse = Inverse.of(bread, nothing)
    count, most = len(scores), max(table.shape[1] for table in tables.values())
    scattered = inverse.sandwiched(scores.T @ scores, nothing) * (count / max(1, count - most))
    white = inverse.sandwiched(bread, nothing)
    wider = np.sqrt(np.maximum(1.0, np.diag(white) / np.maximum(np.diag(scattered), 1e-300)))
    covariance = scattered * np.outer(wider, wider) + inverse.open
    wanted = [0, 1, 2, *gains, *constants[:3]]
    return np.asarray(covariance[np.ix_(wanted, wanted)])


def _air_covariance(problem: _Problem, moving: Tables, found: Mapping[str, Array]) -> Array:
    """Return the covariance (10, 10) of effects of airspeed that the accelerometer does not show.

    The mean loss of thrust by airspeed is unknown: its standard error is its variation along the
    flight, or the constant of the specific force. It enters the gains of roll and pitch, with the
    accelerometer's bias along z. The moment of drag is known to `DRAG_MOMENT_ERROR`, which matters
    most in gentle flights. Thrust of rotors that rise or sink as the vehicle turns changes with
    their axial airspeed: half of that damping is unknown. A relative error of a gain may also be a
    phase error, hence an error of the lags.
    """
    gain, decline = found["thrust"][:2]
    left = []
    for stretch, shared, table in zip(
        problem.stretches, problem.shared, moving["thrust"], strict=True
    ):
        lift = low_pass(table, problem.step, THRUST_BAND_HZ) @ [gain, decline]
        left.append(shared[stretch.inside[:-1], 2] / lift)
    taken = float(np.concatenate(left).std())
    fastest = min(problem.vehicle.aerodynamics.max_relative_airspeed, MAX_AIRSPEED)
    shares = []
    for name in OUTPUTS[:2]:
        turned = np.concatenate(
            [low_pass(m[:, None], problem.step) for m in problem.measured[name]]
        )
        force = np.concatenate([still[:, DRAG_COLUMN] for still in problem.fixed[name]])
        arm = abs(float(_rotor_positions(problem.vehicle)[:, 2].mean())) * abs(found[name][0])
        told = DRAG_MOMENT_ERROR * arm * force.std()
        turning = turned.std() + GYRO_NOISE
        rate = np.concatenate([still[:, RATE_COLUMN] for still in problem.fixed[name]]).std()
        squares = np.mean(levers(problem.vehicle)[:, OUTPUTS.index(name)] ** 2)
        damped = 0.5 * abs(found[name][0]) * GRAVITY * squares / fastest * rate
        told = np.hypot(told, damped) / turning
        shares.append(float(np.sqrt(taken**2 + (BIAS_SD / GRAVITY) ** 2 + told**2)))
    both = float(np.mean(shares))
    deviations = np.zeros(len(NUMBER_NAMES))
    deviations[:3] = both, both, both * MAX_PHASE_LAG_S
    deviations[3:5] = np.abs([found[name][0] for name in OUTPUTS[:2]]) * shares
    offset = found["thrust"][moving["thrust"][0].shape[1] + CONSTANT_COLUMN] / GRAVITY
    deviations[-len(STEADY) :] = TRIM_SD
    deviations[NUMBER_NAMES.index("thrust")] = gain * np.hypot(taken, offset)
    return np.diag(deviations**2)

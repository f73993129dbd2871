"""Laws of force and moment that a fitted model lacks, by what it leaves of accelerations.

The accelerations of a fitted model, along the recorded motion, leave errors. What of them no change
of the fitted coefficients can explain is regressed on a dictionary of what forces and moments may
go with (`FEATURES`): airspeed, body rates, the rotors' speed. A feature counts if its efficient
score, summed over stretches of `STRETCH`, is larger than the largest of all features' would be by
chance: every stretch's contribution changes its sign at random (the wild bootstrap, clustered),
which keeps what is correlated within a stretch and among features, and counts how many are tried.
The likeliest is taken into the model, and the others are judged again.

Features, and what coefficients change, are those of the simulated flight, which follows the
reference as the recorded one does and knows nothing of its gusts and of its sensors' noise: what
the loop answers to gusts passes for no law (an instrumental variable; Ljung, 7.6). Errors are
filtered as in `tuner.equation_error.regression`.

Sources: Cameron, Gelbach and Miller, "Bootstrap-based improvements for inference with clustered
errors", 2008; Romano and Wolf, "Stepwise multiple testing as formalized data snooping", 2005.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from tuner.core.numerics import Array, unit_diagonal
from tuner.equation_error.model_accelerations import Linear, ModelAccelerations
from tuner.equation_error.recorded_accelerations import Steps, rows_of
from tuner.equation_error.regression import filtered_sums, whitening
from tuner.vehicle.coefficient import Parameter
from tuner.vehicle.model import Model

MEMORY = 0.3
"""s of errors from which the next one is predicted."""
STRETCH = 1.0
"""s whose scores are summed up: what is left of gusts in filtered errors has ended by then."""
LEVEL = 0.005
"""Probability of a false alarm among all features."""
SIGNS = 2000
"""Draws of the stretches' signs."""
OWN = 0.05
"""Share of a feature's information that no other column may have, or it is not told from those."""
SHIFTS, MOVED = 4, 1e-3
"""In how many ways a motor's curve and lags move rotor speeds, and by how much they are moved."""
MOST = 5
"""Features that are told at most."""
LATE = ("rotor_speed", "late")
"""What is told of the rotors' speeds: their lateness against the gyro, by all moments."""
AXES = ("force_x", "force_y", "force_z", "moment_x", "moment_y", "moment_z")


class Pair(NamedTuple):
    """The steps of a flight as they were recorded, and as the fit flies them.

    ``driven``: whether the recorded rotor speeds are those that the fit makes of commands; what
    these may be off by is not told then.
    """

    recorded: Steps
    simulated: Steps
    driven: bool


@dataclass(frozen=True)
class Law:
    """A law of which the model has nothing.

    Attributes
    ----------
    axis, feature
        Of `AXES`, and of its `FEATURES`.
    share
        The size of its part of the accelerations over that of all that is modelled there (root mean
        squares about the mean), with the sign of its coefficient.
    """

    axis: str
    feature: str
    share: float


@dataclass(frozen=True)
class Unexplained:
    """What no coefficient of a fit explains.

    Attributes
    ----------
    laws
        The likeliest first.
    accelerations
        Of each flight (N, 6), m/s² and rad/s², body axes, what all of them make.
    speed_lag
        s by which recorded rotor speeds come after the turning that they make: stamped late, or
        filtered; zero if that is chance.
    """

    laws: tuple[Law, ...]
    accelerations: tuple[Array, ...]
    speed_lag: float = 0.0


@dataclass(frozen=True)
class _Motion:
    """What features are made of, at N steps: a flight's airspeed, body rates, and loads.

    Attributes
    ----------
    v, w
        (N, 3) m/s and rad/s, body axes.
    faster
        (N,) the rotors' mean speed over that of all flights, less one.
    modelled
        (N, 6) the model's accelerations.
    """

    v: Array
    w: Array
    faster: Array
    modelled: Array


def _fast(m: _Motion) -> Array:
    return np.asarray(np.linalg.norm(m.v, axis=1))


Feature = Callable[[_Motion], Array]


def _force_across(axis: int) -> dict[str, Feature]:
    return {
        "airspeed": lambda m: m.v[:, axis],
        "airspeed_squared": lambda m: m.v[:, axis] * _fast(m),
        "airspeed_across": lambda m: m.v[:, 1 - axis],
    }


def _moment_across(axis: int) -> dict[str, Feature]:
    return {
        "airspeed": lambda m: m.v[:, axis],
        "airspeed_across": lambda m: m.v[:, 1 - axis],
        "rate": lambda m: m.w[:, axis],
        "rate_squared": lambda m: m.w[:, axis] * np.abs(m.w[:, axis]),
        "other_rates": lambda m: m.w[:, 1 - axis] * m.w[:, 2],
    }


#: Axis -> name -> what a force or moment along it may go with.
FEATURES: Mapping[str, Mapping[str, Feature]] = {
    "force_x": _force_across(0),
    "force_y": _force_across(1),
    "force_z": {
        "rotor_speed": lambda m: m.modelled[:, 2] * m.faster,
        "airspeed": lambda m: m.v[:, 2],
        "airspeed_squared": lambda m: m.v[:, 2] * _fast(m),
        "airspeed_across": lambda m: m.v[:, 0] ** 2 + m.v[:, 1] ** 2,
    },
    "moment_x": _moment_across(0),
    "moment_y": _moment_across(1),
    "moment_z": {
        "rate": lambda m: m.w[:, 2],
        "rate_squared": lambda m: m.w[:, 2] * np.abs(m.w[:, 2]),
        "other_rates": lambda m: m.w[:, 0] * m.w[:, 1],
    },
}


def unexplained(
    model: Model,
    parameters: Sequence[Parameter],
    point: Array,
    flights: Sequence[Pair],
) -> Unexplained:
    """Return what recorded accelerations hold that no fitted coefficient explains.

    Parameters
    ----------
    model, parameters, point
        Of the fit: what does not move, its K parameters, and their scaled coordinates.
    """
    recorded, simulated, driven = zip(*flights, strict=True)
    along = ModelAccelerations(model, tuple(parameters), simulated).noiseless.at(point)
    moved = [other for part in simulated for other in _moved(part)]
    made = ModelAccelerations(model, (), (*recorded, *moved)).noiseless.at(np.zeros(0))
    mean = float(np.mean([part.rotor_speed.mean() for part in simulated]))
    names = [*((axis, name) for axis, features in FEATURES.items() for name in features), LATE]
    motions, tables, sums = list[_Motion](), list[Array](), list[tuple[Array, Array]]()
    for number, (one, real, of_commands) in enumerate(zip(along, made, driven, strict=False)):
        ends = made[len(recorded) + SHIFTS * number :][:SHIFTS]
        shift = np.stack([(one.left - end.left) / MOVED for end in ends], 2)
        motion = _motion(one, mean)
        nuisances = _nuisances(one.steps, motion, (number, len(along)), of_commands)
        table = np.concatenate([_features(motion), _late(shift) * (not of_commands)], axis=2)
        columns = np.concatenate([one.columns, nuisances, shift * of_commands, table], axis=2)
        units = len(columns) // max(1, round(STRETCH / real.steps.step))
        filters = whitening(real, MEMORY)
        sums.append(filtered_sums(replace(real, columns=columns), filters, units)[:2])
        motions.append(motion)
        tables.append(table)
    first = sums[0][1].shape[1] - len(names)
    information, score = (np.concatenate(parts) for parts in zip(*sums, strict=True))
    # lateness is no law: it is judged by itself, and first
    told = _likeliest(information, score, range(first), [first + len(names) - 1])
    while len(told) < MOST:
        rest = [i for i in range(first, first + len(names) - 1) if i not in told]
        likeliest = _likeliest(information, score, [*range(first), *told], rest)
        if not likeliest:
            break
        told += likeliest
    sizes = np.zeros(len(names))
    if told:
        inside = [*range(first), *told]
        solved = _solved(information.sum(axis=0), inside, score.sum(axis=0))
        sizes[np.array(told) - first] = solved[first:]
    modelled = np.concatenate([motion.modelled for motion in motions]).std(axis=0)
    parts, laws = np.concatenate(tables).std(axis=0), []
    for number in (column - first for column in told):
        axis, name = names[number]
        if (axis, name) != LATE:
            row = AXES.index(axis)
            laws.append(Law(axis, name, float(parts[row, number] * sizes[number] / modelled[row])))
    made_of_laws = tuple(table[..., :-1] @ sizes[:-1] for table in tables)
    return Unexplained(tuple(laws), made_of_laws, float(sizes[-1]))


def _moved(part: Steps) -> list[Steps]:
    """Return the steps with rotor speeds as a motor's curve and its lags move them."""
    speed, change = part.rotor_speed, part.rotor_acceleration
    ways = (np.ones_like(speed), speed, np.maximum(change, 0.0), np.minimum(change, 0.0))
    return [replace(part, rotor_speed=speed + MOVED * way) for way in ways]


def _motion(one: Linear, mean: float) -> _Motion:
    motion = one.steps.motion
    return _Motion(
        v=rows_of(motion.attitude.to_body(motion.velocity)),
        w=rows_of(motion.body_rate),
        faster=one.steps.rotor_speed.mean(axis=1) / mean - 1.0,
        modelled=one.steps.accelerations - one.left,
    )


def _features(motion: _Motion) -> Array:
    """Return all features (N, 6, M), each along its own axis."""
    rows = [
        (AXES.index(axis), feature(motion))
        for axis, features in FEATURES.items()
        for feature in features.values()
    ]
    table = np.zeros((len(motion.v), len(AXES), len(rows)))
    for number, (axis, values) in enumerate(rows):
        table[:, axis, number] = values
    return table


def _late(shift: Array) -> Array:
    """Return what moments (N, 6, 1) are short of for each s by which rotor speeds are late."""
    column = shift[..., 2:].sum(axis=2, keepdims=True)
    column[:, :3] = 0.0
    return np.asarray(column)


def _nuisances(part: Steps, motion: _Motion, place: tuple[int, int], of_commands: bool) -> Array:
    """Return (N, 6, n) what else errors may be, and is not told.

    A steady one of each axis in each flight (``place``: which of how many); what a thrust looks
    like along x and y from an attitude that is tilted or late; what comes late of each force, whose
    clock is another than the gyro's, and of each moment where rotor speeds are made of commands.
    """
    number, flights = place
    table = np.zeros((len(motion.v), 6, 6 * flights + 12))
    every, delayed = np.arange(6), np.arange(6 if of_commands else 3)
    table[:, every, 6 * number + every] = 1.0
    changes = np.gradient(motion.modelled, part.step, axis=0)
    table[:, delayed, 6 * flights + delayed] = changes[:, delayed]
    tilted = np.column_stack([motion.modelled[:, 2], motion.w[:, :2]])
    for axis in (0, 1):
        columns = 6 * flights + 6 + 3 * axis + np.arange(3)
        table[:, axis, columns] = tilted
    return table


def _solved(total: Array, inside: Sequence[int], right: Array) -> Array:
    """Return what solves the normal equations of some columns; what they do not tell is zero."""
    square = total[np.ix_(inside, inside)]
    unit = unit_diagonal(square)
    inverse = np.linalg.pinv(square * np.outer(unit, unit), rcond=1e-9, hermitian=True)
    by = unit.reshape(-1, *[1] * (right.ndim - 1))
    return np.asarray(by * (inverse @ (by * right[list(inside)])))


def _likeliest(
    information: Array, score: Array, model: Sequence[int], rest: Sequence[int]
) -> list[int]:
    """Return the column whose efficient score is the largest; none where that may be chance."""
    total, model, rest = information.sum(axis=0), list(model), list(rest)
    estimate = _solved(total, model, score.sum(axis=0))
    follow = _solved(total, model, total[:, rest])
    left = score - information[:, :, model] @ estimate
    efficient = left[:, rest] - left[:, model] @ follow
    own = np.diag(total)[rest]
    alone = own - np.einsum("mr,mr->r", total[np.ix_(model, rest)], follow)
    tells = alone > OWN * own
    if not tells.any():
        return []
    sd = np.maximum(np.sqrt(np.sum(efficient**2, axis=0)), 1e-300)
    size = np.where(tells, np.abs(efficient.sum(axis=0)) / sd, 0.0)
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (SIGNS, len(efficient)))
    chance = np.abs(signs @ efficient / sd)[:, tells].max(axis=1)
    best = int(np.argmax(size))
    return [rest[best]] if size[best] > np.quantile(chance, 1.0 - LEVEL) else []

"""Laws of force and moment that a fitted model omits, from its errors of accelerations.

The accelerations of a fitted model, along the recorded motion, leave errors. The part that no
change of the fitted coefficients explains is regressed on a dictionary of features (`FEATURES`):
airspeed, body rates, the rotors' speed. A feature is significant if its efficient score, summed
over stretches of `STRETCH_S`, exceeds the largest of all features' by chance: the contribution of
every stretch gets a random sign (the clustered wild bootstrap), which keeps correlation within a
stretch and among features, and accounts for their number. The likeliest is added to the model, and
the others are tested again.

Features and derivatives are those of the simulated flight, which follows the same reference without
the recorded gusts and sensor noise, so that the loop's response to gusts is not taken for a law
(an instrumental variable; Ljung, 7.6). Errors are filtered as in `tuner.equation_error.regression`.

Sources: Cameron, Gelbach and Miller, "Bootstrap-based improvements for inference with clustered
errors", 2008; Romano and Wolf, "Stepwise multiple testing as formalized data snooping", 2005.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tuner.core.numerics import Array, unit_diagonal
from tuner.equation_error.model_accelerations import LinearisedAccelerations, ModelAccelerations
from tuner.equation_error.recorded_accelerations import Steps, rows_of
from tuner.equation_error.regression import filtered_sums, whitening
from tuner.vehicle.coefficient import Parameter
from tuner.vehicle.model import Model

MEMORY_S = 0.3
"""Length of the error's autoregressive model."""
STRETCH_S = 1.0
"""Length of a stretch, beyond the correlation of gusts in filtered errors."""
FALSE_ALARM_LEVEL = 0.005
"""Probability of a false alarm among all features."""
BOOTSTRAP_DRAWS = 2000
"""Draws of the stretches' signs."""
MIN_OWN_INFORMATION = 0.05
"""Least share of a feature's information that other columns do not explain."""
MOTOR_SHIFTS, SPEED_STEP = 4, 1e-3
"""Number of ways in which a motor's curve and lags change rotor speeds, and their step."""
MAX_LAWS = 5
"""Largest number of features found."""
SPEED_LAG = ("rotor_speed", "late")
"""The column of a lag of rotor speeds behind the gyro, in all moments."""
AXES = ("force_x", "force_y", "force_z", "moment_x", "moment_y", "moment_z")


@dataclass(frozen=True)
class Law:
    """A law that the model omits.

    Attributes
    ----------
    axis, feature
        Of `AXES`, and of its `FEATURES`.
    share
        Standard deviation of its acceleration over that of all modelled ones, with the sign of its
        coefficient.
    """

    axis: str
    feature: str
    share: float


@dataclass(frozen=True)
class OmittedLaws:
    """The laws that a fit omits.

    Attributes
    ----------
    laws
        The likeliest first.
    accelerations
        Sum of the laws' accelerations of each flight (N, 6), m/s² and rad/s², body axes.
    speed_lag
        s by which recorded rotor speeds lag behind the turning that they cause: stamped late, or
        filtered; zero if not significant.
    """

    laws: tuple[Law, ...]
    accelerations: tuple[Array, ...]
    speed_lag: float = 0.0


@dataclass(frozen=True)
class _Motion:
    """The motion that features are computed from, at N steps.

    Attributes
    ----------
    v, w
        (N, 3) m/s and rad/s, body axes.
    speed_excess
        (N,) the rotors' mean speed over that of all flights, less one.
    modelled
        (N, 6) the model's accelerations.
    """

    v: Array
    w: Array
    speed_excess: Array
    modelled: Array


def _airspeed(m: _Motion) -> Array:
    return np.asarray(np.linalg.norm(m.v, axis=1))


Feature = Callable[[_Motion], Array]


def _force_across(axis: int) -> dict[str, Feature]:
    return {
        "airspeed": lambda m: m.v[:, axis],
        "airspeed_squared": lambda m: m.v[:, axis] * _airspeed(m),
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


#: Axis -> name -> feature of a force or moment along it.
FEATURES: Mapping[str, Mapping[str, Feature]] = {
    "force_x": _force_across(0),
    "force_y": _force_across(1),
    "force_z": {
        "rotor_speed": lambda m: m.modelled[:, 2] * m.speed_excess,
        "airspeed": lambda m: m.v[:, 2],
        "airspeed_squared": lambda m: m.v[:, 2] * _airspeed(m),
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


def find_omitted_laws(
    model: Model,
    parameters: Sequence[Parameter],
    point: Array,
    flights: Sequence[tuple[Steps, Steps, bool]],
) -> OmittedLaws:
    """Return the laws in recorded accelerations that no fitted coefficient explains.

    Parameters
    ----------
    model, parameters, point
        The fit's: fixed coefficients, K parameters, and their scaled coordinates.
    flights
        The steps of each as recorded and as simulated by the fit, and whether rotor speeds come
        from commands by the fit's motors, whose errors are then nuisances.
    """
    recorded, simulated, by_command = zip(*flights, strict=True)
    along = ModelAccelerations(model, tuple(parameters), simulated).at(point)
    moved = [other for part in simulated for other in _motor_shifts(part)]
    made = ModelAccelerations(model, (), (*recorded, *moved)).at(np.zeros(0))
    mean = float(np.mean([part.rotor_speed.mean() for part in simulated]))
    names = [*((axis, name) for axis, features in FEATURES.items() for name in features), SPEED_LAG]
    motions, tables, sums = list[_Motion](), list[Array](), list[tuple[Array, Array]]()
    for number, (one, real, of_commands) in enumerate(zip(along, made, by_command, strict=False)):
        ends = made[len(recorded) + MOTOR_SHIFTS * number :][:MOTOR_SHIFTS]
        shift = np.stack([(one.errors - end.errors) / SPEED_STEP for end in ends], 2)
        motion = _motion(one, mean)
        nuisances = _nuisances(one.steps, motion, (number, len(along)), of_commands)
        table = np.concatenate([_features(motion), _lag_column(shift) * (not of_commands)], axis=2)
        columns = np.concatenate([one.columns, nuisances, shift * of_commands, table], axis=2)
        units = len(columns) // max(1, round(STRETCH_S / real.steps.step))
        filters = whitening(real, [MEMORY_S] * len(AXES))
        sums.append(filtered_sums(replace(real, columns=columns), filters, units)[:2])
        motions.append(motion)
        tables.append(table)
    first = sums[0][1].shape[1] - len(names)
    information, score = (np.concatenate(parts) for parts in zip(*sums, strict=True))
    # the lag of rotor speeds is no law: it is tested by itself, and first
    chosen = _likeliest(information, score, range(first), [first + len(names) - 1])
    while len(chosen) < MAX_LAWS:
        rest = [i for i in range(first, first + len(names) - 1) if i not in chosen]
        likeliest = _likeliest(information, score, [*range(first), *chosen], rest)
        if not likeliest:
            break
        chosen += likeliest
    sizes = np.zeros(len(names))
    if chosen:
        inside = [*range(first), *chosen]
        solved = _solved(information.sum(axis=0), inside, score.sum(axis=0))
        sizes[np.array(chosen) - first] = solved[first:]
    modelled = np.concatenate([motion.modelled for motion in motions]).std(axis=0)
    parts, laws = np.concatenate(tables).std(axis=0), []
    for number in (column - first for column in chosen):
        axis, name = names[number]
        if (axis, name) != SPEED_LAG:
            row = AXES.index(axis)
            laws.append(Law(axis, name, float(parts[row, number] * sizes[number] / modelled[row])))
    made_of_laws = tuple(table[..., :-1] @ sizes[:-1] for table in tables)
    return OmittedLaws(tuple(laws), made_of_laws, float(sizes[-1]))


def _motor_shifts(part: Steps) -> list[Steps]:
    """Return the steps with rotor speeds changed as by a motor's curve and its lags."""
    speed, change = part.rotor_speed, part.rotor_acceleration
    ways = (np.ones_like(speed), speed, np.maximum(change, 0.0), np.minimum(change, 0.0))
    return [replace(part, rotor_speed=speed + SPEED_STEP * way) for way in ways]


def _motion(one: LinearisedAccelerations, mean: float) -> _Motion:
    motion = one.steps.motion
    return _Motion(
        v=rows_of(motion.attitude.to_body(motion.velocity)),
        w=rows_of(motion.body_rate),
        speed_excess=one.steps.rotor_speed.mean(axis=1) / mean - 1.0,
        modelled=one.steps.accelerations - one.errors,
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


def _lag_column(shift: Array) -> Array:
    """Return the change of moments (N, 6, 1) per s of lag of rotor speeds."""
    column = shift[..., 2:].sum(axis=2, keepdims=True)
    column[:, :3] = 0.0
    return np.asarray(column)


def _nuisances(part: Steps, motion: _Motion, place: tuple[int, int], of_commands: bool) -> Array:
    """Return the nuisance columns (N, 6, n) of errors.

    A constant of each axis in each flight (``place``: number and count); thrust along x and y by an
    attitude that is tilted or late; a delay of each force, whose clock is not the gyro's, and of
    each moment where rotor speeds come from commands.
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
    """Return the least-norm solution of the normal equations of some columns."""
    square = total[np.ix_(inside, inside)]
    unit = unit_diagonal(square)
    inverse = np.linalg.pinv(square * np.outer(unit, unit), rcond=1e-9, hermitian=True)
    by = unit.reshape(-1, *[1] * (right.ndim - 1))
    return np.asarray(by * (inverse @ (by * right[list(inside)])))


def _likeliest(
    information: Array, score: Array, model: Sequence[int], rest: Sequence[int]
) -> list[int]:
    """Return the column with the largest efficient score; none where that is not significant."""
    total, model, rest = information.sum(axis=0), list(model), list(rest)
    estimate = _solved(total, model, score.sum(axis=0))
    follow = _solved(total, model, total[:, rest])
    left = score - information[:, :, model] @ estimate
    efficient = left[:, rest] - left[:, model] @ follow
    own = np.diag(total)[rest]
    alone = own - np.einsum("mr,mr->r", total[np.ix_(model, rest)], follow)
    determined = alone > MIN_OWN_INFORMATION * own
    if not determined.any():
        return []
    sd = np.maximum(np.sqrt(np.sum(efficient**2, axis=0)), 1e-300)
    size = np.where(determined, np.abs(efficient.sum(axis=0)) / sd, 0.0)
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (BOOTSTRAP_DRAWS, len(efficient)))
    chance = np.abs(signs @ efficient / sd)[:, determined].max(axis=1)
    best = int(np.argmax(size))
    return [rest[best]] if size[best] > np.quantile(chance, 1.0 - FALSE_ALARM_LEVEL) else []

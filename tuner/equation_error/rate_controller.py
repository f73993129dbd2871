"""A rate controller as recorded, against the one of its file: gains and lag of each axis.

Each axis's torque set-point, as the mixer has it, is regressed on the error of the body rate, its
integral, and the angular acceleration, of recorded flights and of the fit's own. Simulated signals
are the instruments of both (Ljung, System Identification, 7.6): they know nothing of a gyro's noise
and of gusts, and a loop that answers both biases nothing. What sampling and filters make of such a
regression they make of both, so that the ratio of its coefficients is that of the gains (indirect
inference; Gourieroux, Monfort and Renault 1993).

How far coefficients scatter is what is left of the regression, taken for stationary (Newey and West
1987). What filters make of the step of a set-point is not: so scores of stretches of `STRETCH` have
to speak against chance, too, by as many degrees of freedom as there are stretches that tell most.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri, stdtrit  # scipy.stats takes a quarter of a second to import

from tuner.core.numerics import Array, unit_diagonal

STRETCH = 1.0
"""s whose scores are summed up."""
MEMORY = 0.3
"""s over which what is left is correlated."""
LEVEL = 0.005
"""Probability of a false alarm among all axes and parts."""
AT_LEAST = 0.05
"""That for each of them by the scores of stretches."""
AXES = ("roll", "pitch", "yaw")
PARTS = ("P", "I", "late")
SMALLEST = {"P": 0.02, "I": 0.1, "late": 5e-4}
"""Change of a gain as a share of it, and s, below which nothing is found."""
FOLLOWED = 0.5
"""Slope of a flight's torque over that simulated from which this is an instrument: a loop near its
edge swings, and no simulation keeps its phase."""
APART = 1e-6
"""Inverse condition from which columns are told apart."""


class Signals(NamedTuple):
    """What a rate controller hears and says, (N, 3) roll, pitch, yaw in FRD, every ``step`` s.

    ``error`` is set-point minus gyro and ``rate`` the gyro, rad/s; ``torque`` is normalised.
    """

    step: float
    error: Array
    rate: Array
    torque: Array


class ControllerEstimate(NamedTuple):
    """How a gain compares with the file's.

    ``part`` is of `PARTS`; ``value`` the gain over the file's, or s by which an axis answers its
    gyro later than the file's filters and D let it; ``sd`` its standard error; ``differs`` whether
    they differ by more than chance; ``flight`` the one that alone has that gain.
    """

    axis: str
    part: str
    value: float
    sd: float
    differs: bool
    flight: str = ""


def estimate_controller(
    recorded: Sequence[Signals], simulated: Sequence[Signals]
) -> tuple[ControllerEstimate, ...]:
    """Return how each gain that flights tell compares with the file's.

    Parameters
    ----------
    recorded, simulated
        Of each flight, at the same times.
    """
    known = [_of_axis(recorded, simulated, axis) for axis in range(3)]
    _share_lateness(known)
    told = sum(len(parts) for parts in known)
    return tuple(
        ControllerEstimate(
            name,
            part,
            one.value,
            one.sd,
            one.is_sure(LEVEL / told) and abs(one.value - one.neutral) > SMALLEST[part],
        )
        for name, parts in zip(AXES, known, strict=True)
        for part, one in parts.items()
    )


def others_gains(recorded: Sequence[Signals], simulated: Sequence[Signals]) -> tuple[int, ...]:
    """Return the flights, of three or more, whose P is none that the others have.

    Parameters are those of `estimate_controller`.
    """
    odd, rest = list[int](), list(range(len(recorded)))
    while len(rest) > 2:
        apart = {
            number: max(_apart(recorded, simulated, number, rest, axis) for axis in range(3))
            for number in rest
        }
        furthest = max(apart, key=lambda number: apart[number])
        if not apart[furthest]:
            break
        odd.append(furthest)
        rest.remove(furthest)
    return tuple(sorted(odd))


def _apart(
    recorded: Sequence[Signals],
    simulated: Sequence[Signals],
    number: int,
    rest: Sequence[int],
    axis: int,
) -> float:
    """Return by how many standard errors a flight's P is off the others'; zero for chance."""
    others = [other for other in rest if other != number]
    own, all_others = (
        _of_axis([recorded[i] for i in some], [simulated[i] for i in some], axis).get("P")
        for some in ([number], others)
    )
    if own is None or all_others is None:
        return 0.0
    sd, off = float(np.hypot(own.sd, all_others.sd)), abs(own.value - all_others.value)
    compared = own._replace(neutral=all_others.value, sd=sd)
    sure = off > SMALLEST["P"] and compared.is_sure(LEVEL / (len(AXES) * len(rest)))
    return off / sd if sure else 0.0


class _Part(NamedTuple):
    """A part's value, its standard error, what the file says, and how stretches (S,) move it."""

    value: float
    neutral: float
    sd: float
    moves: Array

    def is_sure(self, level: float) -> bool:
        """Return whether it is not neutral, by what is left and by the stretches."""
        square = self.moves**2
        count = float(square.sum() ** 2 / max((square**2).sum(), 1e-300))
        off, scatter = abs(self.value - self.neutral), float(np.sqrt(square.sum()))
        return (
            count > 2.0
            and off > float(ndtri(1.0 - 0.5 * level)) * self.sd
            and off > float(stdtrit(count - 1.0, 1.0 - 0.5 * AT_LEAST)) * scatter
        )


def _of_axis(
    recorded: Sequence[Signals], simulated: Sequence[Signals], axis: int
) -> dict[str, _Part]:
    """Return the parts of one axis; none where its flights do not tell them apart."""
    real = [_regression(signals, axis) for signals in recorded]
    made = [
        _followed(_regression(signals, axis), torque)
        for signals, (_, torque) in zip(simulated, real, strict=True)
    ]
    own = np.sum([z.T @ z for z, _ in made], axis=0)
    both = list(zip(made, real, strict=True))
    total = np.sum([z.T @ x for (z, _), (x, _) in both], axis=0)
    if not own.any() or min(map(_condition, (own, total))) < APART:
        return {}
    of_file = np.linalg.solve(own, np.sum([z.T @ torque for z, torque in made], axis=0))
    gains = np.linalg.solve(total, np.sum([z.T @ torque for (z, _), (_, torque) in both], axis=0))
    scores, square = [], np.zeros((3, 3))
    for (z, _), (x, torque), signals in zip(made, real, recorded, strict=True):
        left = torque - x @ gains
        square += _square_of_sum(z, left, max(1, round(MEMORY / signals.step)))
        many = max(round(len(left) * signals.step / STRETCH), 1)
        scores += [z[rows].T @ left[rows] for rows in np.array_split(np.arange(len(left)), many)]
    inverse = np.linalg.inv(total)
    late, of_filters = gains[2] / gains[0], of_file[2] / of_file[0]
    along = {
        "P": (gains[0] / of_file[0], 1.0, np.array([1.0, 0.0, 0.0]) / of_file[0]),
        "I": (gains[1] / of_file[1], 1.0, np.array([0.0, 1.0, 0.0]) / of_file[1]),
        "late": (late - of_filters, 0.0, np.array([-late, 0.0, 1.0]) / gains[0]),
    }
    parts = {}
    for name, (value, neutral, direction) in along.items():
        weights = inverse.T @ direction
        sd = float(np.sqrt(max(weights @ square @ weights, 0.0)))
        parts[name] = _Part(float(value), neutral, sd, np.array(scores) @ weights)
    return parts


def _followed(made: tuple[Array, Array], torque: Array) -> tuple[Array, Array]:
    """Return a simulated flight's columns and torque, zero where none was recorded like them."""
    columns, of_file = made
    follows = float(of_file @ torque > FOLLOWED * (of_file @ of_file))
    return follows * columns, follows * of_file


def _square_of_sum(instruments: Array, left: Array, memory: int) -> Array:
    """Return the mean square (3, 3) of the sum of instruments (N, 3) times what is left (N,)."""
    count = len(left)
    square = np.mean(left**2) * instruments.T @ instruments
    for apart in range(1, min(memory, count - 1) + 1):
        alike = left[apart:] @ left[:-apart] / count * (1.0 - apart / (memory + 1.0))
        across = instruments[apart:].T @ instruments[:-apart]
        square = square + alike * (across + across.T)
    return np.asarray(square)


def _share_lateness(known: list[dict[str, _Part]]) -> None:
    """Give roll and pitch the mean of their latenesses, and yaw none: they share their filters.

    What yaw answers late it answers to few steps.
    """
    late = [parts.pop("late") for parts in known if parts]
    if not all(known[:2]):
        return
    weights = np.array([1.0 / max(one.sd**2, 1e-300) for one in late[:2]])
    weights /= weights.sum()
    value = sum(float(w) * one.value for w, one in zip(weights, late, strict=False))
    moves = sum(w * one.moves for w, one in zip(weights, late, strict=False))
    sd = np.hypot(*(w * one.sd for w, one in zip(weights, late, strict=False)))
    for parts in known[:2]:
        parts["late"] = _Part(value, 0.0, float(sd), np.asarray(moves))


def _regression(signals: Signals, axis: int) -> tuple[Array, Array]:
    """Return columns (N, 3) and torque (N,), about their trends.

    What a recorded gyro reads when at rest is not what the loop heard, and its integral is a ramp.
    """
    error, step = signals.error[:, axis], signals.step
    integral = np.concatenate([[0.0], np.cumsum(0.5 * (error[1:] + error[:-1]))]) * step
    faster = np.gradient(signals.rate[:, axis], step)
    columns = np.column_stack([error, integral, faster])
    return _detrended(columns), _detrended(signals.torque[:, axis])


def _detrended(series: Array) -> Array:
    """Return a series (N, ...) less its mean and its slope."""
    time = np.linspace(-1.0, 1.0, len(series))
    about = series - series.mean(axis=0)
    return np.asarray(about - np.multiply.outer(time, time @ about / (time @ time)))


def _condition(square: Array) -> float:
    """Return the inverse condition of a matrix of unit diagonal."""
    unit = unit_diagonal(square)
    return float(1.0 / np.linalg.cond(square * np.outer(unit, unit)))

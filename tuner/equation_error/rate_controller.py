"""Estimation of a rate controller's gains and latency from recorded commands.

Each axis's torque set-point, as the mixer has it, is regressed on the error of the body rate, its
integral, and the angular acceleration, of recorded flights and of the fit's own. Simulated signals
are the instruments of both (Ljung, System Identification, 7.6): they are free of the recorded gyro
noise and gusts, so that the loop's response to these causes no bias. Sampling and filters have the
same effect on both regressions, so that the ratio of coefficients is that of the gains (indirect
inference; Gourieroux, Monfort and Renault 1993).

Standard errors are those of stationary residuals (Newey and West 1987). Responses of filters to
steps of a set-point are not stationary: so estimates have to be significant by the scatter of the
scores of stretches of `STRETCH_S`, too, with the effective number of stretches.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri, stdtrit  # scipy.stats takes a quarter of a second to import

from tuner.core.numerics import Array, unit_diagonal

STRETCH_S = 1.0
"""Length of a stretch whose scores are summed."""
MEMORY_S = 0.3
"""Correlation length of residuals."""
FALSE_ALARM_LEVEL = 0.005
"""Probability of a false alarm among all axes and parts."""
STRETCH_LEVEL = 0.05
"""Probability of a false alarm of each by the scores of stretches."""
AXES = ("roll", "pitch", "yaw")
PARTS = ("P", "I", "late")
MIN_CHANGE = {"P": 0.02, "I": 0.1, "late": 5e-4}
"""Least difference that is reported: relative for gains, s for the latency."""
MAX_SD_OF_ONE_FLIGHT = 0.1
"""Largest standard error of one flight's P over the file's: beyond it instruments are weak, and
estimates far from normal (Staiger and Stock 1997)."""
MIN_INSTRUMENT_SLOPE = 0.5
"""Least slope of recorded over simulated torque of a flight that is an instrument: near the limit
of stability a loop oscillates, and a simulation loses its phase."""
MIN_RECIPROCAL_CONDITION = 1e-6
"""Least reciprocal condition number of the regression."""


class Signals(NamedTuple):
    """Inputs and output of a rate controller, (N, 3) roll, pitch, yaw in FRD, every ``step`` s.

    ``error`` is set-point minus gyro and ``rate`` the gyro, rad/s; ``torque`` is normalised.
    """

    step: float
    error: Array
    rate: Array
    torque: Array


class ControllerEstimate(NamedTuple):
    """An estimate of a gain or latency relative to the file's.

    ``part`` is of `PARTS`; ``value`` the gain over the file's, or s by which an axis responds later
    to its gyro than the file's filters and D explain; ``sd`` its standard error; ``differs``
    whether the difference is significant and large enough; ``flight`` the only one with that gain;
    ``simulated_p`` the axis' P as simulated signals show it, less than the file's where they clip.
    """

    axis: str
    part: str
    value: float
    sd: float
    differs: bool
    flight: str = ""
    simulated_p: float = float("nan")


def estimate_controller(
    recorded: Sequence[Signals], simulated: Sequence[Signals]
) -> tuple[ControllerEstimate, ...]:
    """Return the estimates that flights determine.

    ``recorded`` and ``simulated`` are signals of each flight at the same times.
    """
    known = [_axis_estimates(recorded, simulated, axis) for axis in range(3)]
    _share_latency(known)
    tests = sum(len(parts) for parts in known)
    return tuple(
        ControllerEstimate(
            name,
            part,
            one.value,
            one.sd,
            one.is_significant(FALSE_ALARM_LEVEL / tests)
            and abs(one.value - one.neutral) > MIN_CHANGE[part],
            simulated_p=one.simulated_p,
        )
        for name, parts in zip(AXES, known, strict=True)
        for part, one in parts.items()
    )


def others_gains(recorded: Sequence[Signals], simulated: Sequence[Signals]) -> tuple[int, ...]:
    """Return the flights, of three or more, whose P differs from that of the others.

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
    """Return the difference of a flight's P from the others' in standard errors; 0 for chance.

    The flight's error is that if its P were the others' (a score test): the instruments of one
    flight are weak, and where chance makes them seem strong the error about an estimate is small,
    and the estimate off.
    """
    others = [other for other in rest if other != number]

    def of(some: Sequence[int], p: float | None = None) -> _Part | None:
        flown = [recorded[i] for i in some], [simulated[i] for i in some]
        return _axis_estimates(*flown, axis, p=p).get("P")

    all_others = of(others)
    own = None if all_others is None else of([number], all_others.value)
    if own is None or all_others is None or own.sd > MAX_SD_OF_ONE_FLIGHT:
        return 0.0
    sd, off = float(np.hypot(own.sd, all_others.sd)), abs(own.value - all_others.value)
    compared = own._replace(neutral=all_others.value, sd=sd)
    sure = off > MIN_CHANGE["P"] and compared.is_significant(
        FALSE_ALARM_LEVEL / (len(AXES) * len(rest))
    )
    return off / sd if sure else 0.0


class _Part(NamedTuple):
    """A part's value, the file's, its standard error, and contributions of stretches (S,).

    ``simulated_p`` as of a `ControllerEstimate`.
    """

    value: float
    neutral: float
    sd: float
    moves: Array
    simulated_p: float = float("nan")

    def is_significant(self, level: float) -> bool:
        """Return whether it differs from the file's, by its error and by the stretches' scatter."""
        square = self.moves**2
        count = float(square.sum() ** 2 / max((square**2).sum(), 1e-300))
        off, scatter = abs(self.value - self.neutral), float(np.sqrt(square.sum()))
        return (
            count > 2.0
            and off > float(ndtri(1.0 - 0.5 * level)) * self.sd
            and off > float(stdtrit(count - 1.0, 1.0 - 0.5 * STRETCH_LEVEL)) * scatter
        )


def _axis_estimates(
    recorded: Sequence[Signals], simulated: Sequence[Signals], axis: int, *, p: float | None = None
) -> dict[str, _Part]:
    """Return the parts of one axis; none where the regression is singular.

    With ``p``, errors are those if P were so many times the file's.
    """
    real = [_regression(signals, axis) for signals in recorded]
    made = [
        _as_instrument(_regression(signals, axis), torque)
        for signals, (_, torque) in zip(simulated, real, strict=True)
    ]
    own = np.sum([z.T @ z for z, _ in made], axis=0)
    both = list(zip(made, real, strict=True))
    total = np.sum([z.T @ x for (z, _), (x, _) in both], axis=0)
    if not own.any() or min(map(_condition, (own, total))) < MIN_RECIPROCAL_CONDITION:
        return {}
    of_file = np.linalg.solve(own, np.sum([z.T @ torque for z, torque in made], axis=0))
    moments = np.sum([z.T @ torque for (z, _), (_, torque) in both], axis=0)
    gains = supposed = np.linalg.solve(total, moments)
    if p is not None:
        left = moments - total[:, 0] * p * of_file[0]
        supposed = np.append(p * of_file[0], np.linalg.solve(total[1:, 1:], left[1:]))
    scores, square = [], np.zeros((3, 3))
    for (z, _), (x, torque), signals in zip(made, real, recorded, strict=True):
        left = torque - x @ supposed
        square += square_of_sum(z, left, max(1, round(MEMORY_S / signals.step)))
        many = max(round(len(left) * signals.step / STRETCH_S), 1)
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
        moves = np.array(scores) @ weights
        parts[name] = _Part(float(value), neutral, sd, moves, float(of_file[0]))
    return parts


def _as_instrument(made: tuple[Array, Array], torque: Array) -> tuple[Array, Array]:
    """Return a simulated flight's columns and torque, zero where the recorded ones differ."""
    columns, of_file = made
    follows = float(of_file @ torque > MIN_INSTRUMENT_SLOPE * (of_file @ of_file))
    return follows * columns, follows * of_file


def square_of_sum(instruments: Array, left: Array, memory: int) -> Array:
    """Return the mean square (3, 3) of the sum of instruments (N, 3) times residuals (N,)."""
    count = len(left)
    square = np.mean(left**2) * instruments.T @ instruments
    for apart in range(1, min(memory, count - 1) + 1):
        alike = left[apart:] @ left[:-apart] / count * (1.0 - apart / (memory + 1.0))
        across = instruments[apart:].T @ instruments[:-apart]
        square = square + alike * (across + across.T)
    return np.asarray(square)


def _share_latency(known: list[dict[str, _Part]]) -> None:
    """Give roll and pitch the mean of their latencies, and yaw none: they share their filters.

    Where they differ it is not the filters: one has another ratio of D to P, and keeps its own.
    Yaw has too few steps to estimate its latency.
    """
    late = [parts.pop("late") for parts in known if parts]
    if not all(known[:2]):
        return
    roll, pitch = late[:2]
    apart = _Part(
        roll.value - pitch.value, 0.0, float(np.hypot(roll.sd, pitch.sd)), roll.moves - pitch.moves
    )
    if abs(apart.value) > MIN_CHANGE["late"] and apart.is_significant(FALSE_ALARM_LEVEL):
        known[0]["late"], known[1]["late"] = roll, pitch
        return
    weights = np.array([1.0 / max(one.sd**2, 1e-300) for one in late[:2]])
    weights /= weights.sum()
    value = sum(float(w) * one.value for w, one in zip(weights, late, strict=False))
    moves = sum(w * one.moves for w, one in zip(weights, late, strict=False))
    sd = np.hypot(*(w * one.sd for w, one in zip(weights, late, strict=False)))
    for parts in known[:2]:
        parts["late"] = _Part(value, 0.0, float(sd), np.asarray(moves))


def _regression(signals: Signals, axis: int) -> tuple[Array, Array]:
    """Return columns (N - 2, 3) and torque (N - 2,), detrended, of all samples but both ends.

    The recorded gyro's bias is not that of the loop, and its integral is a ramp. At the ends there
    are one-sided differences alone, of twice the noise: no stationary residuals, where a spin
    begins.
    """
    error, rate, step = signals.error[:, axis], signals.rate[:, axis], signals.step
    integral = np.cumsum(0.5 * (error[1:-1] + error[:-2])) * step
    faster = (rate[2:] - rate[:-2]) / (2.0 * step)
    columns = np.column_stack([error[1:-1], integral, faster])
    return _detrended(columns), _detrended(signals.torque[1:-1, axis])


def _detrended(series: Array) -> Array:
    """Return a series (N, ...) less its mean and its slope."""
    time = np.linspace(-1.0, 1.0, len(series))
    about = series - series.mean(axis=0)
    return np.asarray(about - np.multiply.outer(time, time @ about / (time @ time)))


def _condition(square: Array) -> float:
    """Return the inverse condition of a matrix of unit diagonal."""
    unit = unit_diagonal(square)
    return float(1.0 / np.linalg.cond(square * np.outer(unit, unit)))

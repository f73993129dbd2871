"""Dirt out of one signal: order, duplicates, NaN, quaternions, outliers; everything is counted."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from tuner.recordings.flight import Array
from tuner.recordings.notes import Kind, Note, NoteCode
from tuner.recordings.outliers import HONEST, excursions, frozen, sticking_out

#: Signals that cannot leave a range; a value beyond it is a corrupt sample.
RANGES: Mapping[str, tuple[float, float]] = {
    "position": (-1e5, 1e5),
    "velocity": (-1e3, 1e3),
    "attitude": (-1e3, 1e3),
    "body_rate": (-1e4, 1e4),
    "acceleration": (-1e4, 1e4),
    "reference_position": (-1e5, 1e5),
    "reference_velocity": (-1e3, 1e3),
    "reference_acceleration": (-1e4, 1e4),
    "rate_setpoint": (-1e4, 1e4),
    "attitude_setpoint": (-1e3, 1e3),
    "lap": (-1e6, 1e6),
    "command": (-0.02, 1.02),
    "thrust_setpoint": (-0.02, 1.02),
    "commanded_thrust": (-1e4, 1e4),
    "commanded_torque": (-1e4, 1e4),
    "rotor_speed": (0.0, 100_000.0),  # in revolutions a minute, if nothing says the unit
    "battery_voltage": (1.0, 100.0),  # nothing flies on less: a meter that was not read
}

#: Share of samples out of range above which a signal is in another unit rather than corrupt.
WHOLLY = 0.5

#: No recording lasts longer, in s, to either side of its middle.
LONGEST = 43_200.0


def clean(
    signal: str, topic: str, time: Array, values: Array
) -> tuple[Array, Array, tuple[Note, ...]]:
    """Return the trustworthy samples of a signal in strictly increasing time.

    Parameters
    ----------
    signal
        Name in `SIGNALS`; decides which tests apply.
    topic
        Named in the notes.
    time
        (n,) seconds, any order.
    values
        (n, k).

    Returns
    -------
    tuple
        Time (m,), values (m, k) with m <= n, and what was dropped or repaired.
    """
    notes = []

    def note(count: int, code: NoteCode, kind: Kind = "info", **numbers: float) -> None:
        if count:
            notes.append(Note(code, kind, topic, int(count), numbers, (signal,)))

    low, high = RANGES.get(signal, (-np.inf, np.inf))
    beyond: NDArray[np.bool_] = np.asarray((values < low) | (values > high), dtype=np.bool_)
    dropped = int(beyond.any(axis=1).sum())
    if dropped > WHOLLY * len(values):
        median = float(np.nanmedian(values))
        note(dropped, NoteCode.UNIT_UNKNOWN, "warning", lower=low, upper=high, median=median)
    else:
        note(dropped, NoteCode.OUT_OF_RANGE, lower=low, upper=high)
    values = np.where(beyond, np.nan, values)
    if signal in {"command", "thrust_setpoint"}:
        values = np.clip(values, 0.0, 1.0)

    one_per_row = signal == "rotor_speed"
    empty = np.isnan(values).all(axis=1) if one_per_row else np.isnan(values).any(axis=1)
    empty |= ~np.isfinite(time)
    counted = np.asarray(beyond.any(axis=1))
    note(int((empty & ~counted).sum()), NoteCode.NOT_A_NUMBER)
    usable = np.logical_not(empty)
    time, values = time[usable], values[usable]

    late = int((np.diff(time) < 0).sum())
    note(late, NoteCode.OUT_OF_ORDER)
    order = np.argsort(time, kind="stable")
    time, values = time[order], values[order]
    apart = np.abs(time - np.median(time)) > LONGEST if len(time) else np.zeros(0, dtype=np.bool_)
    note(int(apart.sum()), NoteCode.FAR_IN_TIME)
    time, values = time[~apart], values[~apart]
    time, values, doubles = _merge_equal_times(time, values)
    note(doubles, NoteCode.STAMPED_TWICE)
    note(0 if signal == "lap" else _missing(time), NoteCode.SAMPLES_MISSING)

    if signal == "attitude":
        time, values, odd = _unit_quaternions(time, values)
        note(odd, NoteCode.NO_UNIT_QUATERNION)

    if signal in HONEST:
        time, values = _without_outliers(signal, time, values, note)
    return time, values, tuple(notes)


def _without_outliers(
    signal: str, time: Array, values: Array, note: Callable[..., None]
) -> tuple[Array, Array]:
    """Drop what cannot be true, and note it."""
    honest = HONEST[signal]
    if signal in ("position", "attitude"):
        stuck = frozen(time, values, honest)
        note(int(stuck.sum()), NoteCode.REPEATED)
        away, lasting = excursions(time[~stuck], values[~stuck], honest)
        note(int(away.sum()), NoteCode.AWAY_AND_BACK)
        note(lasting, NoteCode.AWAY_FOR_GOOD, "warning")
        time, values = time[~stuck][~away], values[~stuck][~away]
    outlier = np.zeros(values.shape, dtype=np.bool_)
    for column in range(values.shape[1]):
        measured = np.flatnonzero(np.isfinite(values[:, column]))
        outlier[measured, column] = sticking_out(time[measured], values[measured, column], honest)
    note(int(outlier.any(axis=1).sum()), NoteCode.OUTLIERS)
    if signal == "rotor_speed":
        values = np.where(outlier, np.nan, values)
        keep = np.isfinite(values).any(axis=1)
    else:
        keep = np.asarray(~outlier.any(axis=1))
    return time[keep], values[keep]


def _missing(time: Array) -> int:
    """Return how many samples a steady publisher lost; 0 where the rate is not steady."""
    if len(time) < 20:
        return 0
    steps = np.diff(time)
    usual = np.median(steps)
    near = np.abs(steps - usual) < 0.5 * usual
    if near.mean() < 0.75:
        return 0
    return int(np.sum(np.rint(steps[~near] / usual) - 1, where=steps[~near] > usual))


def _merge_equal_times(time: Array, values: Array) -> tuple[Array, Array, int]:
    """Keep one row of each time; the columns that a row lacks are filled from its twins."""
    if len(time) < 2 or np.all(np.diff(time) > 0):
        return time, values, 0
    kept, start = np.unique(time, return_index=True)
    merged = values[start]
    filled = 0
    for row, (first, last) in enumerate(zip(start, [*start[1:], len(time)], strict=True)):
        for twin in range(first + 1, last):
            lacking = np.isnan(merged[row]) & np.isfinite(values[twin])
            merged[row, lacking] = values[twin, lacking]
            filled += bool(lacking.any())
    return kept, merged, len(time) - len(kept) - filled


def _unit_quaternions(time: Array, values: Array) -> tuple[Array, Array, int]:
    """Normalise, drop what has no direction, and let the sign follow the sample before."""
    norm = np.linalg.norm(values, axis=1)
    usable = norm > 0.5
    odd = int((np.abs(norm - 1) > 0.01).sum())
    time, unit = time[usable], values[usable] / norm[usable, None]
    if len(unit) > 1:
        flips = np.where((unit[1:] * unit[:-1]).sum(axis=1) < 0, -1.0, 1.0)
        unit = unit * np.concatenate([[1.0], np.cumprod(flips)])[:, None]
    if len(unit) and unit[0, 0] < 0:
        unit = -unit
    return time, unit, odd

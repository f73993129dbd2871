"""Signals on one uniform clock: linear, along the shortest arc, or held."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from tuner.recordings.flight import SIGNALS, Array, Series

#: Beyond this gap between two samples, in s, nothing is known; slower signals get three periods.
GAP = 0.25
#: Seconds after their last sample for which counters hold.
FOREVER = np.inf
#: Periods of a regular publisher between two samples beyond which one is missing.
MISSED = 1.5


def resample(signal: str, series: Series, clock: Array) -> Array:
    """Return the (N, k) values of a signal on a uniform clock (N,), NaN where none are known."""
    columns, _, way = SIGNALS[signal]
    result = np.full((len(clock), columns), np.nan)
    if len(series.time) == 0:
        return result
    if way == "arc":
        return _along_arc(series, clock)
    for column in range(columns):
        measured = np.isfinite(series.values[:, column])
        if not measured.any():
            continue
        time, values = series.time[measured], series.values[measured, column]
        if way == "linear":
            result[:, column] = np.interp(clock, time, values)
            result[np.logical_not(_covered(time, clock)), column] = np.nan
        else:
            gap = FOREVER if signal == "lap" else longest_gap(time)
            result[:, column] = _hold(time, values, clock, gap)
    return result


def without_gaps(series: Series) -> Series:
    """Return a signal that is published at a steady rate with the samples that were not recorded.

    Recorders drop messages that the flight controller received. Held through such a gap, a
    reference at 4 m/s would lag by 4 cm for 10 ms and kick the vehicle. The missing samples lie on
    a monotone cubic through their neighbours (Fritsch and Butland 1984), so that a step stays one.
    Longer gaps than are bridged anywhere (`GAP`) are left.
    """
    known = np.isfinite(series.values).all(axis=1)
    time, values = series.time[known], series.values[known]
    if len(time) < 2:
        return series
    steps = np.diff(time)
    period = float(np.median(steps))
    gaps = np.flatnonzero((steps > MISSED * period) & (steps <= longest_gap(time)))
    if len(gaps) == 0:
        return series
    counts = np.round(steps[gaps] / period).astype(int)
    missing = np.concatenate(
        [
            time[gap] + steps[gap] * np.arange(1, count) / count
            for gap, count in zip(gaps, counts, strict=True)
        ]
    )
    steady = np.sort(np.concatenate([time, missing]))
    between = PchipInterpolator(time, values)(steady)
    between[np.searchsorted(steady, time)] = values
    return Series(steady, between)


def longest_gap(time: Array) -> float:
    """Return the s between samples beyond which nothing is known."""
    return max(GAP, 3 * float(np.median(np.diff(time)))) if len(time) > 1 else GAP


def _covered(time: Array, clock: Array) -> NDArray[np.bool_]:
    """Return for which instants samples lie on both sides, not too far apart."""
    after = np.clip(np.searchsorted(time, clock, side="left"), 0, len(time) - 1)
    before = np.clip(np.searchsorted(time, clock, side="right") - 1, 0, len(time) - 1)
    inside = (clock >= time[0]) & (clock <= time[-1])
    near = time[after] - time[before] <= longest_gap(time)
    return np.asarray(inside & near, dtype=np.bool_)


def _along_arc(series: Series, clock: Array) -> Array:
    """Turn from each sample to the next at constant speed along the shorter arc (slerp)."""
    result = np.full((len(clock), 4), np.nan)
    known = _covered(series.time, clock)
    if len(series.time) < 2 or not known.any():
        return result
    at = clock[known]
    after = np.clip(np.searchsorted(series.time, at), 1, len(series.time) - 1)
    start, end = series.values[after - 1], series.values[after]
    part = (at - series.time[after - 1]) / (series.time[after] - series.time[after - 1])
    cosine = (start * end).sum(axis=1)
    end = np.where(cosine[:, None] < 0, -end, end)
    angle = np.arccos(np.clip(np.abs(cosine), 0.0, 1.0))
    # Below this angle the arc is a line to machine precision, and its sine divides badly.
    tiny = angle < 1e-6
    sine = np.where(tiny, 1.0, np.sin(angle))
    from_start = np.where(tiny, 1 - part, np.sin((1 - part) * angle) / sine)
    from_end = np.where(tiny, part, np.sin(part * angle) / sine)
    arc = from_start[:, None] * start + from_end[:, None] * end
    arc /= np.linalg.norm(arc, axis=1)[:, None]
    flips = np.where((arc[1:] * arc[:-1]).sum(axis=1) < 0, -1.0, 1.0)
    sign = np.concatenate([[1.0], np.cumprod(flips)])
    result[known] = arc * (sign if arc[0, 0] >= 0 else -sign)[:, None]
    return result


def _hold(time: Array, values: Array, clock: Array, gap: float) -> Array:
    # A nanosecond of tolerance: stamps that were moved onto ticks carry rounding errors.
    index = np.searchsorted(time, clock + 1e-9, side="right") - 1
    known = (index >= 0) & (clock - time[np.maximum(index, 0)] <= gap)
    return np.where(known, values[np.maximum(index, 0)], np.nan)

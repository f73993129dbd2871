"""Recorded signals made ready to be fed in: read at any time, completed, or set to zero."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from tuner.recordings.flight import SIGNALS, Array, Flight, Series
from tuner.recordings.interpolation import body_rate_from

MISSED = 1.5
"""Periods of a loop between two samples beyond which its output was not recorded in full."""


def sparse(flights: Sequence[Flight], signal: str, update_rate: float) -> bool:
    """Return whether a signal was recorded less often than it was computed, at a rate in Hz."""
    gaps = np.concatenate([np.diff(flight.series[signal].time) for flight in flights])
    return bool(np.median(gaps) * update_rate > MISSED)


def zero_order_hold(series: Series, clock: Array) -> Array:
    """Read a signal (n, k) that holds until its next sample, at (m,) times in s."""
    columns = []
    for column in series.values.T:
        known = np.isfinite(column)
        place = np.searchsorted(series.time[known], clock + 1e-9, side="right") - 1
        columns.append(column[known][np.maximum(place, 0)])
    return np.column_stack(columns)


def linear_interpolation(series: Series, clock: Array) -> Array:
    """Read a signal (n, k) that moves linearly between its samples, at (m,) times in s."""
    columns = []
    for column in series.values.T:
        known = np.isfinite(column)
        columns.append(np.interp(clock, series.time[known], column[known]))
    return np.column_stack(columns)


def reference_points(flight: Flight, length: int) -> list[Array]:
    """Return position, velocity and acceleration, each (3, length), the last point repeated."""
    parts = []
    for name in ("reference_position", "reference_velocity", "reference_acceleration"):
        values = flight.signals.get(name)
        rows = np.zeros((len(flight.time), 3)) if values is None else np.nan_to_num(values)
        parts.append(np.pad(rows, ((0, length - len(rows)), (0, 0)), mode="edge").T)
    return parts


def with_body_rate(flight: Flight) -> Flight:
    """Return a flight with a body rate: the attitude's change, where no gyro was recorded."""
    if flight.has("body_rate"):
        return flight
    turns = flight.series["attitude"]
    rate = body_rate_from(turns.values, np.gradient(turns.values, turns.time, axis=0))
    return replace(flight, series={**flight.series, "body_rate": Series(turns.time, rate)})


def zeroed(flight: Flight, names: Collection[str]) -> Flight:
    """Return a flight whose signals are zero throughout, its attitude level."""
    rows = {name: np.zeros(SIGNALS[name][0]) for name in names}
    if "attitude" in rows:
        rows["attitude"][0] = 1.0
    ends = np.array([0.0, flight.duration])
    signals = {name: np.tile(row, (len(flight.time), 1)) for name, row in rows.items()}
    series = {name: Series(ends, np.tile(row, (2, 1))) for name, row in rows.items()}
    return replace(
        flight, signals={**flight.signals, **signals}, series={**flight.series, **series}
    )

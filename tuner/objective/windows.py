"""A flight cut into short ones, each of which starts from the recorded state: multiple shooting.

What is simulated strays from what was recorded, the further the longer; over a second it stays near
enough for a fit to find its way from almost anywhere, and a window needs no gentle beginning.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from tuner.errors import RecordingError
from tuner.flights.flight import Flight, Series
from tuner.flights.initial import initial_state

BEFORE = 1.2
"""s of a recording before a window that may help to estimate its start."""
BEHIND = 0.1
"""s of a recording after a window that may help as well."""
FEWEST = 8
"""Poses that a stretch must hold to be a window."""


@dataclass(frozen=True)
class Window:
    """A stretch of a flight.

    Attributes
    ----------
    flight
        The stretch as a flight of its own, its time 0 at its beginning.
    begin
        s since the mission's start.
    """

    flight: Flight
    begin: float


def windows_of(flight: Flight, seconds: float) -> tuple[Window, ...]:
    """Cut a flight into windows of so many s, one behind the other.

    A stretch with hardly a pose in it is left out, and so is a rest shorter than half a window.

    Raises
    ------
    RecordingError
        No stretch of the flight holds enough poses.
    """
    count = max(1, round(seconds * flight.rate))
    windows = []
    for first in range(0, len(flight.time) - count // 2, count):
        last = min(first + count, len(flight.time) - 1)
        window = _window(flight, first, last)
        if window is not None:
            windows.append(window)
    if not windows:
        raise RecordingError(
            flight.path, f"holds no {seconds:g} s with poses throughout", "record motion capture"
        )
    return tuple(windows)


def _window(flight: Flight, first: int, last: int) -> Window | None:
    begin, end = float(flight.time[first]), float(flight.time[last])
    series = _around(flight.series, begin, end)
    position = series.get("position")
    if position is None or "attitude" not in series:
        return None
    inside = (position.time >= 0) & (position.time <= end - begin)
    if inside.sum() < FEWEST or np.diff(position.time[inside]).max() > 0.5 * (end - begin):
        return None
    stretch = replace(
        flight,
        time=flight.time[first : last + 1] - begin,
        signals={name: rows[first : last + 1] for name, rows in flight.signals.items()},
        series=series,
        initial=initial_state(series),
    )
    known = (stretch.initial.position, stretch.initial.velocity, stretch.initial.attitude)
    return Window(stretch, begin) if all(np.isfinite(part).all() for part in known) else None


def _around(series: Mapping[str, Series], begin: float, end: float) -> dict[str, Series]:
    cut = {}
    for name, signal in series.items():
        near = (signal.time >= begin - BEFORE) & (signal.time <= end + BEHIND)
        if near.any():
            cut[name] = Series(signal.time[near] - begin, signal.values[near])
    return cut

"""Windows of a flight, each simulated from the recorded state: multiple shooting.

A simulation diverges from the recording with time; over a second it stays close enough for a search
from almost any start, and a window needs no gentle beginning.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tuner.core.errors import RecordingError
from tuner.core.numerics import Array
from tuner.recordings.flight import Flight, InitialState
from tuner.recordings.states import initial_state, states_at

BEFORE_S = 1.2
"""Time before a window whose samples help to estimate its initial state."""
AFTER_S = 0.1
"""Time after a window whose samples help, too."""
MIN_POSES = 8
MAX_UNFED_SHARE = 0.25
"""Longest gap of an input as a share of its window, or else two samples."""
MIN_REGULAR_SHARE = 0.6
"""Least share of regular gaps in a slowly logged signal: the rest of a mostly corrupt signal has
gaps of all lengths."""
MIN_COVERAGE = 0.5
"""Least share of a flight that makes windows: a fit to less of it is no measure of the vehicle."""


@dataclass(frozen=True)
class Window:
    """A stretch of a flight.

    Attributes
    ----------
    flight
        The stretch as a flight of its own, its time 0 at its beginning.
    begin
        s since the mission's start.
    number
        Of the flight, where windows of several lie side by side.
    """

    flight: Flight
    begin: float
    number: int = 0


def windows_of(
    flight: Flight,
    seconds: float,
    *,
    fed: Collection[str] = (),
    stride: float | None = None,
    smoothed_widely: bool = True,
) -> tuple[Window, ...]:
    """Cut a flight into windows of so many s, one behind the other.

    Stretches with too few poses or with a gap of an input are left out, and so is a rest shorter
    than half a window.

    Parameters
    ----------
    flight
        The flight.
    seconds
        s, length of a window.
    fed
        Signals that are fed into the simulation.
    stride
        s from the beginning of a window to that of the next; by default its length.
    smoothed_widely
        Whether a window's initial state is smoothed over 0.1 s on either side, for a free start;
        else it is the recorded state of `tuner.recordings.states`. The windows are the same.

    Raises
    ------
    RecordingError
        No stretch of the flight has enough poses and inputs.
    """
    stretches = _stretches(flight, seconds, stride)
    usable = _usable(flight, stretches, fed)
    windows = []
    if usable:
        states = states_at(flight.series, flight.time[[first for first, _ in usable]])
        windows = [
            _window(flight, first, last, state, smoothed_widely=smoothed_widely)
            for number, (first, last) in enumerate(usable)
            if _is_known(state := states.at(number))
        ]
    if not windows:
        if _usable(flight, stretches, ()):
            what = " and ".join(name.replace("_", " ") for name in fed)
            remedy = "inspect the recording: most of that column may be corrupt"
        else:
            what, remedy = "poses", "record motion capture"
        raise RecordingError(flight.path, f"holds no {seconds:g} s with {what} throughout", remedy)
    return tuple(windows)


def require_windows(flight: Flight, seconds: float, fed: Collection[str]) -> None:
    """Refuse a flight most of which makes no windows.

    Parameters
    ----------
    flight, seconds, fed
        As of `windows_of`.

    Raises
    ------
    RecordingError
        Most of the flight makes no windows: names the signal and the share.
    """
    stretches = _stretches(flight, seconds, None)
    for names in ((), *((name,) for name in fed), fed):
        usable = len(_usable(flight, stretches, names))
        if usable < MIN_COVERAGE * len(stretches):
            what = " and ".join(names).replace("_", " ") or "pose"
            lacking = 100.0 * (1.0 - usable / len(stretches))
            seldom = not names and flight.series["position"].rate * seconds < MIN_POSES
            raise RecordingError(
                flight.path,
                f"lacks a continuous {what} in {lacking:.0f} % of its mission",
                f"log the pose at {np.ceil(MIN_POSES / seconds):.0f} Hz or more"
                if seldom
                else "inspect the recording: samples outside their range are dropped",
            )


def _stretches(flight: Flight, seconds: float, stride: float | None) -> list[tuple[int, int]]:
    """Return the first and last tick of every stretch that may become a window."""
    count = max(1, round(seconds * flight.rate))
    every = count if stride is None else max(1, round(stride * flight.rate))
    return [
        (first, min(first + count, len(flight.time) - 1))
        for first in range(0, len(flight.time) - count // 2, every)
    ]


def _usable(
    flight: Flight, stretches: Sequence[tuple[int, int]], fed: Collection[str]
) -> list[tuple[int, int]]:
    """Return the stretches with enough poses and without gaps of inputs."""
    signals = [flight.series.get(name) for name in ("position", "attitude", *fed)]
    series = [signal for signal in signals if signal is not None]
    known = [s.time[np.isfinite(column)] for s in series[2:] for column in s.values.T]
    if None in signals or any(len(time) < 2 for time in known):
        return []
    gaps = [(time, 2.0 * _period(time)) for time in known]

    def is_known(begin: float, end: float) -> bool:
        pose = _between(series[0].time, begin, end)
        if len(pose) < MIN_POSES or np.diff(pose).max() > 0.5 * (end - begin):
            return False
        return all(
            np.diff(_between(time, begin, end), prepend=begin, append=end).max()
            <= max(MAX_UNFED_SHARE * (end - begin), gap)
            for time, gap in gaps
        )

    time = flight.time
    return [(a, b) for a, b in stretches if is_known(float(time[a]), float(time[b]))]


def _between(time: Array, begin: float, end: float) -> Array:
    return time[np.searchsorted(time, begin) : np.searchsorted(time, end, side="right")]


def _period(time: Array) -> float:
    """Return the period of samples in s; 0 for a signal most of which was dropped."""
    steps = np.diff(time)
    usual = float(np.median(steps))
    return usual if np.mean(np.abs(steps - usual) < 0.5 * usual) > MIN_REGULAR_SHARE else 0.0


def _window(
    flight: Flight, first: int, last: int, recorded: InitialState, *, smoothed_widely: bool
) -> Window:
    begin, end = float(flight.time[first]), float(flight.time[last])
    kept = (begin - BEFORE_S, end + AFTER_S)
    near = {name: s.between(*kept, origin=begin) for name, s in flight.series.items()}
    series = {name: s for name, s in near.items() if len(s.time)}
    initial = recorded
    if smoothed_widely:  # unless a gap leaves too few samples
        smoothed = initial_state(series)
        initial = smoothed if _is_known(smoothed) else recorded
    stretch = replace(
        flight,
        time=flight.time[first : last + 1] - begin,
        signals={name: rows[first : last + 1] for name, rows in flight.signals.items()},
        series=series,
        initial=initial,
    )
    return Window(stretch, begin)


def _is_known(state: InitialState) -> bool:
    parts = (state.position, state.velocity, state.attitude)
    return all(bool(np.isfinite(part).all()) for part in parts)

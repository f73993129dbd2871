"""Signals that go on being logged when nothing makes them any more.

A controller that gives up, after a crash say, leaves its variables as they were, and a logger that
reads variables goes on writing them. At the end of such a recording a signal repeats itself to the
bit although the vehicle moves on. One at rest repeats itself too, and is left alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from tuner.flights.flight import Series
from tuner.flights.notes import Note, NoteCode

LASTS = 1.0
"""s for which a signal must not have changed."""
MOVED = 0.05
"""m by which the vehicle must have moved meanwhile."""
MADE = ("attitude", "body_rate")
"""Signals that change whenever a vehicle moves."""


def without_stale(series: Mapping[str, Series]) -> tuple[dict[str, Series], list[Note]]:
    """Return the signals without what repeats itself at their end while the vehicle moves."""
    kept, notes = dict(series), []
    position = series["position"]
    for name in MADE:
        if name not in series:
            continue
        time, values = series[name].time, series[name].values
        changes = np.flatnonzero((values[1:] != values[:-1]).any(axis=1))
        last = int(changes[-1]) + 1 if len(changes) else 0
        if not last or time[-1] - time[last] < LASTS or not _moves(position, time[last]):
            continue
        kept[name] = Series(time[: last + 1], values[: last + 1])
        numbers = {"seconds": float(time[-1] - time[last])}
        notes.append(
            Note(NoteCode.STALE, count=len(time) - last - 1, numbers=numbers, names=(name,))
        )
    return kept, notes


def _moves(position: Series, since: float) -> bool:
    """Return whether the vehicle is seen to move; without a position it is not."""
    places = position.values[(position.time >= since) & np.isfinite(position.values).all(axis=1)]
    return len(places) > 0 and bool(np.ptp(places, axis=0).max() >= MOVED)


def is_stale(series: Mapping[str, Series], notes: Sequence[Note]) -> bool:
    """Return whether a recorded attitude repeats itself at its end while the vehicle moves."""
    last = series["attitude"].values[-2:]
    noted = any(n.code is NoteCode.STALE and "attitude" in n.names for n in notes)
    return noted and bool((last[-1] == last[0]).all())

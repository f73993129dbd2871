"""Signals that go on being logged when nothing makes them any more.

A controller that gives up, after a crash say, leaves its variables as they were, and a logger that
reads variables goes on writing them; motion capture that has lost its markers may send its last
pose for good. At the end of such a recording a signal repeats itself to the bit although the
vehicle moves on, as its position shows or its gyro. One at rest repeats itself too, and is left
alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from tuner.recordings.flight import Array, Series
from tuner.recordings.notes import Note, NoteCode

LASTS = 1.0
"""s for which a signal must not have changed."""
MOVED = 0.05
"""m by which the vehicle must have moved meanwhile."""
TURNED = 0.2
"""rad/s of its gyro, root mean square, that show the same."""
MADE = ("attitude", "body_rate")
"""Signals that change whenever a vehicle moves."""


def without_stale(series: Mapping[str, Series]) -> tuple[dict[str, Series], list[Note]]:
    """Return the signals without what repeats itself at their end while the vehicle moves."""
    kept, notes = dict(series), []
    for name in MADE:
        if name not in series:
            continue
        time, values = series[name].time, series[name].values
        changes = np.flatnonzero((values[1:] != values[:-1]).any(axis=1))
        last = int(changes[-1]) + 1 if len(changes) else 0
        if not last or time[-1] - time[last] < LASTS or not _moves(series, name, time[last]):
            continue
        kept[name] = Series(time[: last + 1], values[: last + 1])
        numbers = {"seconds": float(time[-1] - time[last])}
        notes.append(
            Note(NoteCode.STALE, count=len(time) - last - 1, numbers=numbers, names=(name,))
        )
    return kept, notes


def _moves(series: Mapping[str, Series], stuck: str, since: float) -> bool:
    """Return whether the vehicle is seen to move, by its position or, if not stuck, its gyro."""
    places = _known(series["position"], since)
    if len(places) and np.ptp(places, axis=0).max() >= MOVED:
        return True
    if stuck == "body_rate" or "body_rate" not in series:
        return False
    rates = _known(series["body_rate"], since)
    return len(rates) > 0 and bool(np.sqrt(np.mean(rates**2)) >= TURNED)


def _known(samples: Series, since: float) -> Array:
    """Return the samples (n, k) after a time all of whose columns are known."""
    return samples.values[(samples.time >= since) & np.isfinite(samples.values).all(axis=1)]


def is_stale(series: Mapping[str, Series], notes: Sequence[Note]) -> bool:
    """Return whether a recorded attitude repeats itself at its end while the vehicle moves."""
    last = series["attitude"].values[-2:]
    noted = any(n.code is NoteCode.STALE and "attitude" in n.names for n in notes)
    return noted and bool((last[-1] == last[0]).all())

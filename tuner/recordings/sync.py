"""Clocks that differ between topics: the offset of the pose, found by correlation with the gyro."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tuner.recordings.flight import Array, Series
from tuner.recordings.motion import RATE, alike, body_rate_of, on_clock, rms, smooth, stretch
from tuner.recordings.notes import Note, NoteCode

#: A smaller offset, in s, is left to the fit, which has a time offset and latencies to find.
WORTH_MOVING = 0.02
#: Seconds within which an offset is looked for.
REACH = 0.6
#: How much less unlike the signals must be at the offset than without it.
SHARPER = 0.8
#: Turning below this, in rad/s, or a correlation below that is no evidence.
ENOUGH_TURNING = 0.1
ALIKE = 0.6
#: Seconds over which both are averaged against noise.
WINDOW = 0.1


def pose_offset(series: Mapping[str, Series]) -> float | None:
    """Return by how many seconds the attitude's stamps are late against the gyro's.

    None where one is missing or the vehicle turns too little.
    """
    if "attitude" not in series or "body_rate" not in series:
        return None
    clock = stretch(series)
    if len(clock) < 3 * REACH * RATE:
        return None
    turning = smooth(body_rate_of(on_clock(series, "attitude", clock)), WINDOW)
    gyro = smooth(on_clock(series, "body_rate", clock), WINDOW)
    if rms(gyro) < ENOUGH_TURNING:
        return None
    # The best whole lag first, then a parabola through the three highest points.
    most = round(REACH * RATE)
    lags = np.arange(-most, most + 1)
    score = np.array([_shifted(turning, gyro, int(lag)) for lag in lags])
    best = int(np.argmax(score))
    unlike = 1 - score
    if score[best] < ALIKE or best in (0, len(lags) - 1) or unlike[best] > SHARPER * unlike[most]:
        return 0.0 if score[most] > ALIKE else None
    left, peak, right = score[best - 1 : best + 2]
    bend = left - 2 * peak + right
    fine = 0.5 * (left - right) / bend if bend < 0 else 0.0
    return float((lags[best] + fine) / RATE)


def _shifted(late: Array, early: Array, lag: int) -> float:
    """Return how alike two signals are when the first is moved back by some samples."""
    n = len(late)
    return alike(late[max(0, lag) : n + min(0, lag)], early[max(0, -lag) : n - max(0, lag)])


def align_pose(
    series: Mapping[str, Series], topics: Mapping[str, str]
) -> tuple[dict[str, Series], tuple[Note, ...]]:
    """Move the pose onto the clock of the gyro where they are visibly apart.

    Parameters
    ----------
    series
        Signals in seconds.
    topics
        Signal -> topic; what shares the attitude's topic is moved with it.
    """
    aligned = dict(series)
    topic = topics.get("attitude", "")
    if topic == topics.get("body_rate"):
        return aligned, ()
    offset = pose_offset(series)
    if offset is None:
        return aligned, ()
    if abs(offset) < WORTH_MOVING:
        return aligned, (Note(NoteCode.POSE_ON_TIME, "info", topic, numbers={"seconds": offset}),)
    for signal, samples in series.items():
        if topics.get(signal) == topic:
            aligned[signal] = Series(samples.time - offset, samples.values)
    count = len(series["attitude"].time)
    moved = Note(NoteCode.POSE_MOVED, topic=topic, count=count, numbers={"seconds": offset})
    return aligned, (moved,)

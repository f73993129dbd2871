"""Recordings that deny themselves: nothing flies as they say, so that no fit can use them.

What is doubted of a recording may still fly, in wind or with a poor gyro. What is said here may
not: over a whole mission that moves plenty, the attitude turns against the gyro, or the position
moves against the recorded velocity, as in a recording that runs backwards; or the vehicle
accelerates against its tilt, or plenty without regard to it, as with an attitude of another frame.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from tuner.core.numerics import GRAVITY
from tuner.recordings.flight import Series
from tuner.recordings.mission import Mission
from tuner.recordings.motion import (
    alike,
    body_rate_of,
    derivative,
    on_clock,
    rms,
    smooth,
    stretch,
)
from tuner.recordings.notes import Note, NoteCode
from tuner.recordings.yardstick import Stamped, pull_and_tilt

AGAINST = -0.5
"""Correlation below which two signals that should be alike are opposites."""
UNRELATED = 0.2
"""Correlation, of either sign, of signals that have nothing to do with each other."""
COMMENSURATE = 3.0
"""Times that one of two unrelated signals may be larger: more of it would be noise."""
LASTING = 0.5
"""Correlation of an acceleration with that a bin later, which noise of a position has not."""
LASTS = 5.0
"""s that a mission has to last for any of it to be certain."""
PUSH, TURNING, SPEED = 1.0, 0.3, 0.3
"""m/s^2, rad/s and m/s, root mean square, that are plenty."""


def contradiction(series: Mapping[str, Series], missions: Sequence[Mission]) -> Note | None:
    """Return which two signals certainly deny each other through the longest mission.

    Parameters
    ----------
    series
        Signal -> its samples, in the frames that `frames` finds best.
    missions
        What was flown.
    """
    longest = max(missions, key=lambda m: m.end - m.start, default=None)
    if longest is None or longest.end - longest.start < LASTS:
        return None
    flown = {name: samples.between(longest.start, longest.end) for name, samples in series.items()}
    flown = {name: samples for name, samples in flown.items() if len(samples.time) > 1}
    for pair, opposed in _PAIRS.items():
        if set(pair) <= set(flown) and {"position", "attitude"} <= set(flown):
            agreement = opposed(flown)
            if agreement is not None:
                return Note(NoteCode.CONTRADICTED, numbers={"agreement": agreement}, names=pair)
    return None


def noted_contradiction(notes: Sequence[Note]) -> Note | None:
    """Return what `contradiction` said when a recording was read."""
    return next((note for note in notes if note.code is NoteCode.CONTRADICTED), None)


def _turning(series: Mapping[str, Series]) -> float | None:
    """Return how alike gyro and change of attitude are, if they are opposites."""
    clock = stretch(series)
    turning = smooth(body_rate_of(on_clock(series, "attitude", clock)))
    gyro = smooth(on_clock(series, "body_rate", clock))
    agreement = alike(turning, gyro)
    return agreement if agreement < AGAINST and min(rms(turning), rms(gyro)) > TURNING else None


def _moving(series: Mapping[str, Series]) -> float | None:
    """Return how alike velocity and change of position are, if they are opposites."""
    clock = stretch(series)
    moving = smooth(derivative(on_clock(series, "position", clock)), 0.1)
    velocity = smooth(on_clock(series, "velocity", clock), 0.1)
    agreement = alike(moving, velocity)
    return agreement if agreement < AGAINST and min(rms(moving), rms(velocity)) > SPEED else None


def _leaning(series: Mapping[str, Series]) -> float | None:
    """Return how alike tilt and acceleration are, if one does not follow from the other."""
    position, attitude = (
        Stamped(series[name].time, series[name].values) for name in ("position", "attitude")
    )
    pull, tilt = pull_and_tilt(position, attitude)
    agreement, pushed, leant = alike(pull, tilt), rms(pull), GRAVITY * rms(tilt)
    if pushed < PUSH or leant < PUSH:
        return None
    if agreement < AGAINST:
        return agreement
    alike_in_size = 1 / COMMENSURATE < pushed / leant < COMMENSURATE
    moves = alike(pull[1:], pull[:-1]) > LASTING
    return agreement if abs(agreement) < UNRELATED and alike_in_size and moves else None


#: Signals that deny each other -> how alike they are, None unless that is certain.
_PAIRS: Mapping[tuple[str, str], Callable[[Mapping[str, Series]], float | None]] = {
    ("attitude", "body_rate"): _turning,
    ("position", "velocity"): _moving,
    ("attitude", "position"): _leaning,
}

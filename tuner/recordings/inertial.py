"""Flights without motion capture: gyro, accelerometer and motor commands, and nothing else.

A pose is what a simulation is held against; without one, body rate and specific force remain, which
need none.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tuner.core.disk import readable
from tuner.core.errors import RecordingError
from tuner.recordings.content import ReadOptions, Signals, read_signals
from tuner.recordings.flight import Series
from tuner.recordings.formats import is_tabular
from tuner.recordings.loader import load_flights
from tuner.recordings.missions import IDLE, stretches
from tuner.recordings.notes import Note, NoteCode
from tuner.recordings.sources import require_pose
from tuner.recordings.unit_detection import FASTEST_TURN

#: What a recording must hold.
NEEDS = ("body_rate", "acceleration", "command")
#: Hz below which a log does not show how a vehicle turns.
SLOWEST = 120.0
#: s below which a stretch in the air shows nothing.
SHORTEST = 2.0
#: rad/s, or less, at which a vehicle turns through nine tenths of a gentle flight.
GENTLE = 3.0


@dataclass(frozen=True)
class InertialFlight:
    """What gyro, accelerometer and motor commands say of one flight.

    Attributes
    ----------
    name, path
        Where it comes from.
    series
        `NEEDS`, and the battery's voltage where it was recorded; in s since the first sample.
    flying
        Stretches, in s, in which the motors turn faster than idle.
    notes
        What was dropped, repaired or doubted.
    """

    name: str
    path: str
    series: Mapping[str, Series]
    flying: tuple[tuple[float, float], ...]
    notes: tuple[Note, ...]


def is_inertial(signals: Signals) -> bool:
    """Return whether a recording lacks a pose, but has what a flight can be judged by without."""
    has_pose = {"position", "attitude"} <= set(signals.series)
    return not has_pose and set(NEEDS) <= set(signals.series)


def flying(signals: Signals) -> tuple[tuple[float, float], ...]:
    """Return the stretches, in s, in which the motors turn faster than idle."""
    commands = signals.series["command"]
    turns = np.asarray(commands.values.mean(axis=1) > IDLE, dtype=np.bool_)
    runs = stretches(commands.time, turns)
    return tuple((begin, end) for begin, end in runs if end - begin >= SHORTEST)


def obstacle(signals: Signals, flown: tuple[tuple[float, float], ...]) -> RecordingError | None:
    """Return why nothing can be fitted to a recording without a pose; None if it can.

    Parameters
    ----------
    signals
        Of the recording.
    flown
        The stretches in which its motors turn.
    """
    path, series = signals.recording.path, signals.series
    slow = {name: series[name].rate for name in NEEDS if series[name].rate < SLOWEST}
    if slow:
        rates = ", ".join(f"{name} at {rate:.0f} Hz" for name, rate in slow.items())
        return RecordingError(
            path,
            f"holds no pose, and is too slow to be fitted without one: {rates}",
            f"log {', '.join(NEEDS)} at {SLOWEST:.0f} Hz or more",
        )
    if not flown:
        return RecordingError(
            path, "nothing flies in it: the motors only idle", "check what was recorded of them"
        )
    often = float(np.quantile(np.linalg.norm(series["body_rate"].values, axis=1), 0.9))
    stated = signals.places["body_rate"].source.unit is not None or any(
        note.code is NoteCode.UNIT_READ and note.names[0] == "body_rate" for note in signals.notes
    )
    if is_tabular(signals.recording.format) and not stated and GENTLE < often <= FASTEST_TURN:
        return RecordingError(
            path,
            f"holds no pose, and a body rate of up to {often:.1f} that may be in rad/s or deg/s",
            "give body_rate its unit (si or deg/s) in the topic map",
        )
    return None


def read_inertial(
    path: Path, *, topics: str | Path | None = None, namespace: str = ""
) -> InertialFlight | None:
    """Read a recording that holds no pose; None of one that does, or whose samples are corrupt.

    Raises
    ------
    RecordingError
        The file cannot be read, holds neither a pose nor `NEEDS`, or is too slow, or nothing flies
        in it.
    ConfigError
        The topic map or the side-car is wrong.
    """
    with contextlib.suppress(RecordingError):  # a fit reads them next, from the cache
        load_flights(path, topics=topics, namespace=namespace)
        return None
    options = ReadOptions.of(path, topics, namespace)
    with readable(path):
        signals = read_signals(options, with_pose=False)
    if not is_inertial(signals):
        require_pose(
            signals.recording, signals.topic_map, signals.places, given=options.given is not None
        )
        return None
    runs = flying(signals)
    if (error := obstacle(signals, runs)) is not None:
        raise error
    kept = {
        name: signals.series[name] for name in (*NEEDS, "battery_voltage") if name in signals.series
    }
    return InertialFlight(path.stem, str(path), kept, runs, signals.notes)

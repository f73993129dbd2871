"""Load the `Flight`s of a recording, each mission on its uniform clock, with a cache.

A recording without a pose becomes an `InertialFlight` of gyro, accelerometer and motor commands:
body rate and specific force can be predicted without one.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ConfigDict, TypeAdapter

from tuner.core.disk import exists, readable
from tuner.core.errors import RecordingError
from tuner.core.numerics import Array
from tuner.recordings.cache import cache_file, digest, load, store
from tuner.recordings.clocks import Grid, clock_of
from tuner.recordings.content import (
    Content,
    ReadOptions,
    RecordedSignals,
    content_of,
    read_content,
    read_signals,
)
from tuner.recordings.flight import SIGNALS, Flight, Series
from tuner.recordings.formats import is_tabular
from tuner.recordings.interpolation import max_gap, resample, runs, with_gaps_filled
from tuner.recordings.missions import MAX_IDLE_COMMAND, mission_error, stretches, yaw_spin
from tuner.recordings.notes import Note, NoteCode
from tuner.recordings.states import initial_state
from tuner.recordings.topics import TopicMap
from tuner.recordings.unit_detection import MAX_TURN_RATE

#: The series begin so long before the mission.
PRE_MISSION_S = 2.0
#: Samples up to so long after the mission help to interpolate its end.
POST_MISSION_S = 0.2
#: Longer missions on the uniform clock have broken stamps.
MAX_TICKS = 2_000_000

logger = logging.getLogger(__name__)


def make_flight(content: Content, options: ReadOptions, index: int, *, sha256: str) -> Flight:
    """Put one mission of a recording on its uniform clock.

    Raises
    ------
    RecordingError
        The mission is shorter than two ticks.
    """
    path, rate, series = options.path, options.rate, content.series
    mission = content.missions[index]
    grid = clock_of(series, rate, mission.start - PRE_MISSION_S, mission.end)
    start = grid.tick_nearest(mission.start) if grid else mission.start
    count = math.floor((mission.end - start) * rate + 1e-6) + 1
    if count < 2:
        raise RecordingError(path, "its mission ends where it starts", "inspect the recording")
    if count > MAX_TICKS:
        what = f"its mission lasts {(mission.end - start) / 3600:.0f} h"
        raise RecordingError(path, what, "give 'start' and 'end' in a side-car")
    clock = np.arange(count) / rate
    kept = (start - PRE_MISSION_S, mission.end + POST_MISSION_S + 1e-6)
    nearby = {name: data.between(*kept, origin=start) for name, data in series.items()}
    until = mission.end - start + 1e-6
    mission_series = {name: data.between(-np.inf, until) for name, data in nearby.items()}
    mission_series = {name: data for name, data in mission_series.items() if len(data.time)}
    ticks = dataclasses.replace(grid, origin=grid.origin - start) if grid else None
    notes = list(content.notes)
    if grid is not None and grid.drift:
        notes.append(NoteCode.CLOCK_DRIFTS.note(kind="info", drift=grid.drift))
    if len(content.missions) > 1:
        missions = len(content.missions)
        notes.append(NoteCode.ONE_OF_SEVERAL.note(kind="info", count=missions, number=index + 1))
    if not mission.fitted:
        notes.append(NoteCode.NOT_CHOSEN.note(kind="info"))
    signals = {name: _on_clock(name, nearby[name], clock, ticks) for name in mission_series}
    notes.extend(gap_notes(signals, mission_series, rate))
    yaw_rate, level_held = yaw_spin(mission_series.get("rate_setpoint"), 0.0, float(clock[-1]))
    return Flight(
        name=path.stem if index == 0 else f"{path.stem}-{index + 1}",
        path=str(path),
        sha256=sha256,
        rate=rate,
        time=clock,
        signals=signals,
        series=mission_series,
        initial=initial_state(nearby),
        yaw_rate_setpoint=yaw_rate,
        level_held=level_held,
        trajectory=options.sidecar.trajectory,
        notes=tuple(notes),
        damage=tuple(part.later(-start) for part in content.damage),
    )


def gap_notes(
    signals: Mapping[str, Array], series: Mapping[str, Series], rate: float
) -> Iterator[Note]:
    """Yield notes on signals with gaps."""
    for name, values in signals.items():
        if SIGNALS[name].interpolation == "hold":
            continue
        known = np.isfinite(values).any(axis=1)
        unknown = int((~known).sum())
        if unknown > max_gap(series[name].time) * rate:
            longest = max(behind - first for first, behind in runs(~known))
            yield NoteCode.SIGNAL_UNKNOWN.note(
                name, count=unknown, seconds=unknown / rate, longest=longest / rate
            )


def _on_clock(signal: str, series: Series, clock: Array, grid: Grid | None) -> Array:
    if grid is not None and SIGNALS[signal].interpolation == "hold" and len(series.time) > 1:
        series = Series(grid.snap(series.time), series.values)
    if signal.startswith("reference_"):
        series = with_gaps_filled(series)
    return resample(signal, series, clock)


def _cache_file(options: ReadOptions) -> Path:
    """Return the cache's file for the flights of a recording."""
    path = options.path
    return cache_file("flights", digest(path), path.name, *reading_key(options))


def reading_key(options: ReadOptions) -> tuple[str, ...]:
    """Return all that decides how a recording's content is read, except this program."""
    given = options.topic_map
    messages = [digest(file) for file in given.messages if file.exists()] if given else []
    inputs = (options.namespace, options.rate, options.sidecar, given, messages)
    return tuple(map(repr, inputs))


def load_flights(
    path: str | Path,
    *,
    topics: str | Path | TopicMap | None = None,
    namespace: str = "",
    rate: float = 100.0,
    cache: bool = True,
) -> tuple[Flight, ...]:
    """Read every mission of a recording; see `load_flight`.

    Raises
    ------
    RecordingError
        The file cannot be read, nothing flies in it, or a mission cannot be a flight.
    ConfigError
        The topic map or the side-car is wrong.
    """
    path = Path(path)
    if not exists(path):
        raise RecordingError(path, "no such file", "check the path")
    options = ReadOptions.of(path, topics, namespace, rate)
    if cache and (flights := from_npz(load(_cache_file(options)))) is not None:
        return tuple(dataclasses.replace(flight, path=str(path)) for flight in flights)
    with readable(path):
        content = read_content(options)
    if not content.missions:
        raise mission_error(path, content.series)
    return flights_of(content, options, keep=cache)


def flights_of(content: Content, options: ReadOptions, *, keep: bool) -> tuple[Flight, ...]:
    """Return the flights of a recording that was read.

    Parameters
    ----------
    content, options
        Its content, and the options of reading it.
    keep
        Whether to keep them in the user's cache.

    Raises
    ------
    RecordingError
        A mission is shorter than two ticks, or too long.
    """
    sha256, missions = digest(options.path), range(len(content.missions))
    flights = tuple(make_flight(content, options, i, sha256=sha256) for i in missions)
    if keep and flights:
        store(_cache_file(options), to_npz(flights))
    return flights


def load_flight(
    path: str | Path,
    *,
    topics: str | Path | TopicMap | None = None,
    namespace: str = "",
    rate: float = 100.0,
    mission: int = 1,
    cache: bool = True,
) -> Flight:
    """Read one mission of a recording.

    Parameters
    ----------
    path
        The recording.
    topics
        Topic map, its file, or the name of a shipped one; None takes the shipped map that finds
        most signals.
    namespace
        Prefix of the recorded topics that the map does not have, as ``uav1``.
    rate
        Hz of the uniform clock.
    mission
        The number of the mission, from 1.
    cache
        Whether to use the user's cache.

    Raises
    ------
    RecordingError
        The file cannot be read, or it holds no pose or no such mission.
    ConfigError
        The topic map or the side-car is wrong.
    """
    flights = load_flights(path, topics=topics, namespace=namespace, rate=rate, cache=cache)
    if not 1 <= mission <= len(flights):
        what = f"holds no mission {mission}"
        raise RecordingError(path, what, f"give a number from 1 to {len(flights)}")
    return flights[mission - 1]


def to_npz(flights: Sequence[Flight]) -> bytes:
    """Return flights as the bytes of an ``.npz`` file: their arrays, and the rest as JSON."""
    arrays: list[Array] = []

    def plain(value: object) -> dict[str, Any]:
        if not isinstance(value, np.ndarray):
            return vars(value)
        arrays.append(value)
        return {"array": len(arrays) - 1}

    about, sink = json.dumps(flights, default=plain), io.BytesIO()
    np.savez(sink, *arrays, about=np.frombuffer(about.encode(), np.uint8))
    return sink.getvalue()


def from_npz(content: bytes | None) -> tuple[Flight, ...] | None:
    """Return the flights of an ``.npz`` by `to_npz`; None without content, or if it is damaged."""
    if content is None:
        return None
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as file:

            def restored(held: dict[str, Any]) -> object:
                return file[f"arr_{held['array']}"] if set(held) == {"array"} else held

            known = json.loads(file["about"].tobytes(), object_hook=restored)
        config = ConfigDict(arbitrary_types_allowed=True)
        return TypeAdapter(tuple[Flight, ...], config=config).validate_python(known)
    except Exception as err:  # whatever is wrong with it, the recording is read again
        logger.info("a cached flight is damaged: %s", err)
        return None


#: Signals of a recording without a pose that are needed for a fit.
INERTIAL_SIGNALS = ("body_rate", "acceleration", "command")
#: A slower log does not show angular accelerations.
MIN_RATE_HZ = 120.0
#: A shorter stretch in the air is left out.
MIN_STRETCH_S = 2.0
#: rad/s. A gentle flight turns slower for nine tenths of its time.
GENTLE_TURN_RATE = 3.0


@dataclass(frozen=True)
class InertialFlight:
    """One flight without a pose: gyro, accelerometer and motor commands.

    Attributes
    ----------
    series
        `INERTIAL_SIGNALS` and, if recorded, the battery's voltage; in s since the first sample.
    flying
        Stretches, in s, with motors above idle.
    """

    name: str
    path: str
    series: Mapping[str, Series]
    flying: tuple[tuple[float, float], ...]
    notes: tuple[Note, ...]


def is_inertial(signals: RecordedSignals) -> bool:
    """Return whether a recording lacks a pose, but has all `INERTIAL_SIGNALS`."""
    has_pose = {"position", "attitude"} <= set(signals.series)
    return not has_pose and set(INERTIAL_SIGNALS) <= set(signals.series)


def flying_stretches(signals: RecordedSignals) -> tuple[tuple[float, float], ...]:
    """Return the stretches, in s, with motors above idle."""
    commands = signals.series["command"]
    turns = np.asarray(commands.values.mean(axis=1) > MAX_IDLE_COMMAND, dtype=np.bool_)
    runs = stretches(commands.time, turns)
    return tuple((begin, end) for begin, end in runs if end - begin >= MIN_STRETCH_S)


def inertial_error(
    signals: RecordedSignals, flown: tuple[tuple[float, float], ...]
) -> RecordingError | None:
    """Return why a recording without a pose cannot be fitted; None if it can.

    Parameters
    ----------
    flown
        The stretches with motors above idle.
    """
    path, series = signals.recording.path, signals.series
    slow = {name: series[name].rate for name in INERTIAL_SIGNALS if series[name].rate < MIN_RATE_HZ}
    if slow:
        rates = ", ".join(f"{name} at {rate:.0f} Hz" for name, rate in slow.items())
        return RecordingError(
            path,
            f"holds no pose, and is too slow to be fitted without one: {rates}",
            f"log {', '.join(INERTIAL_SIGNALS)} at {MIN_RATE_HZ:.0f} Hz or more",
        )
    if not flown:
        return RecordingError(
            path, "nothing flies in it: the motors only idle", "check what was recorded of them"
        )
    often = float(np.quantile(np.linalg.norm(series["body_rate"].values, axis=1), 0.9))
    stated = signals.places["body_rate"].source.unit is not None or any(
        note.code is NoteCode.UNIT_READ and note.names[0] == "body_rate" for note in signals.notes
    )
    if (
        is_tabular(signals.recording.format)
        and not stated
        and GENTLE_TURN_RATE < often <= MAX_TURN_RATE
    ):
        return RecordingError(
            path,
            f"holds no pose, and a body rate of up to {often:.1f} that may be in rad/s or deg/s",
            "give body_rate its unit (si or deg/s) in the topic map",
        )
    return None


def read_inertial(
    path: Path, *, topics: str | Path | None = None, namespace: str = ""
) -> InertialFlight | None:
    """Read a recording without a pose; None for one with a pose, whose flights are cached.

    Raises
    ------
    RecordingError
        The file cannot be read, lacks a pose and `INERTIAL_SIGNALS`, is too slow, or holds no
        flight.
    ConfigError
        The topic map or the side-car is wrong.
    """
    options = ReadOptions.of(path, topics, namespace)
    with readable(path):
        if from_npz(load(_cache_file(options))) is not None:
            return None
        signals = read_signals(options)
        if not is_inertial(signals):
            content = content_of(signals, options.sidecar)
            with contextlib.suppress(RecordingError):  # a fit says it next
                flights_of(content, options, keep=True)
            return None
    runs = flying_stretches(signals)
    if (error := inertial_error(signals, runs)) is not None:
        raise error
    kept = {
        name: signals.series[name]
        for name in (*INERTIAL_SIGNALS, "battery_voltage")
        if name in signals.series
    }
    return InertialFlight(path.stem, str(path), kept, runs, signals.notes)

"""Read a recording to say what it holds, whether or not a flight can be made of it."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from tuner.core.disk import readable
from tuner.core.errors import RecordingError
from tuner.recordings.clock import fit_grid
from tuner.recordings.content import (
    Content,
    Settings,
    Signals,
    given_map,
    read_content,
    read_signals,
)
from tuner.recordings.contradiction import noted_contradiction
from tuner.recordings.flight import SIGNALS, Array, Series
from tuner.recordings.formats import open_recording
from tuner.recordings.inertial import flying, is_inertial, obstacle
from tuner.recordings.informs import informed, inlets
from tuner.recordings.inspection import (
    Inspection,
    MissionReport,
    SignalReport,
    TopicReport,
)
from tuner.recordings.load import keep_flights
from tuner.recordings.locate import Place
from tuner.recordings.mission import yaw_spin
from tuner.recordings.motion import RATE, derivative, rotate, smooth
from tuner.recordings.notes import Note, NoteCode
from tuner.recordings.recording import Recording, Samples, Topic
from tuner.recordings.resample import resample
from tuner.recordings.sidecar import Sidecar, read_sidecar
from tuner.recordings.stale import is_stale
from tuner.recordings.sync import pose_offset
from tuner.recordings.topics import TopicMap

#: Stamps before 1990 count from a start-up, not from 1970.
NO_DATE = 631_152_000_000_000_000
#: Seconds of a mission over which speeds are sought.
LOOKED_AT = 3600.0


def examine(
    path: Path, topics: str | Path | TopicMap | None, namespace: str, *, keep: bool = False
) -> Inspection:
    """Inspect a recording.

    Parameters
    ----------
    path, topics, namespace
        As of `tuner.recordings.inspect_recordings`.
    keep
        Whether its flights are kept in the user's cache, for a fit.

    Raises
    ------
    RecordingError
        Nothing of it can be read.
    ConfigError
        The topic map or the side-car is wrong.
    """
    settings = Settings(topics, namespace)
    sidecar = read_sidecar(path)
    given = given_map(path, settings, sidecar)
    with readable(path):
        try:
            content = read_content(path, settings, sidecar, given)
        except RecordingError as err:
            with contextlib.suppress(RecordingError):
                signals = read_signals(path, settings, sidecar, given, with_pose=False)
                if is_inertial(signals):
                    return _without_pose(signals)
            # Its topics are listed nevertheless, so that the user sees what to map.
            recording = open_recording(path, given.messages if given else ())
            return _without_flight(recording, err)
    if keep and content.missions:
        keep_flights(path, content, settings, sidecar, given)
    return _with_flight(content, sidecar)


def _without_pose(signals: Signals) -> Inspection:
    """Return what a recording of gyro, accelerometer and motor commands alone holds."""
    flown = flying(signals)
    error = obstacle(signals, flown)
    seconds = {"seconds": float(sum(end - begin for begin, end in flown))}
    fitted = () if error else (Note(NoteCode.WITHOUT_POSE, "info", numbers=seconds),)
    return replace(
        _with_signals(signals),
        problem=f"{error.what}; {error.remedy}" if error else None,
        inlets=inlets(_columns(signals.series), trajectory=False),
        notes=(*fitted, *signals.notes),
    )


def _without_flight(recording: Recording, problem: RecordingError) -> Inspection:
    return Inspection(
        path=str(recording.path),
        format=recording.format,
        size=_size(recording.path),
        started=None,
        duration=0.0,
        topic_map="",
        problem=f"{problem.what}; {problem.remedy}",
        topics=tuple(
            TopicReport(topic.name, topic.type, topic.count, None, None, None, None, ())
            for topic in recording.topics
        ),
        inlets=inlets({}, trajectory=False),
    )


def _with_flight(content: Content, sidecar: Sidecar) -> Inspection:
    missions = tuple(_mission(content, i) for i in range(len(content.missions)))
    measured = _columns(content.series)
    unusable = is_stale(content.series, content.notes) or noted_contradiction(content.notes)
    if unusable:  # a fit leaves it out
        del measured["attitude"]
    return replace(
        _with_signals(content),
        problem=None if missions else "nothing flies in it: no mission was found",
        missions=missions,
        inlets=inlets(measured, trajectory=sidecar.trajectory is not None),
        coefficients=() if unusable else informed(content.series, measured, missions),
        clock=_clock(content),
        notes=content.notes,
    )


def _with_signals(read: Signals) -> Inspection:
    """Return what is said of a recording's topics and signals, whatever they make."""
    recording, samples = read.recording, read.samples
    times = [s.receive for s in samples.values() if len(s.receive)]
    first, last = min(int(t.min()) for t in times), max(int(t.max()) for t in times)
    return Inspection(
        path=str(recording.path),
        format=recording.format,
        size=_size(recording.path),
        started=_date(first),
        duration=(last - first) * 1e-9,
        topic_map=read.topic_map.name,
        problem=None,
        topics=_topics(recording, read.places, samples),
        signals=_signals(read.series, read.places),
        battery=_battery(read.series),
        damage=read.damage,
    )


def _columns(series: Mapping[str, Series]) -> dict[str, tuple[int, ...]]:
    return {name: _measured(samples) for name, samples in series.items()}


def _size(path: Path) -> int:
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files if file.is_file())


def _date(nanoseconds: int) -> str | None:
    if not NO_DATE < nanoseconds < 8 * NO_DATE:
        return None
    return datetime.fromtimestamp(nanoseconds * 1e-9, UTC).isoformat(timespec="seconds")


def _measured(series: Series) -> tuple[int, ...]:
    return tuple(int(i) for i in np.flatnonzero(np.isfinite(series.values).any(axis=0)))


def _battery(series: Mapping[str, Series]) -> tuple[float, float] | None:
    voltage = series.get("battery_voltage")
    return None if voltage is None else (float(voltage.values[0, 0]), float(voltage.values[-1, 0]))


def _signals(series: Mapping[str, Series], places: Mapping[str, Place]) -> tuple[SignalReport, ...]:
    return tuple(
        SignalReport(
            name,
            places[name].topic,
            SIGNALS[name][1],
            len(samples.time),
            samples.rate,
            _measured(samples),
        )
        for name, samples in series.items()
    )


def _topics(
    recording: Recording, places: Mapping[str, Place], samples: Mapping[str, Samples]
) -> tuple[TopicReport, ...]:
    return tuple(
        _topic(
            topic, samples.get(topic.name), [s for s, p in places.items() if p.topic == topic.name]
        )
        for topic in recording.topics
    )


def _topic(topic: Topic, samples: Samples | None, held: Sequence[str]) -> TopicReport:
    name, kind, count, signals = topic.name, topic.type, topic.count, tuple(held)
    if samples is None or len(samples.receive) < 2:
        return TopicReport(name, kind, count, None, None, None, None, signals)
    time = _seconds(samples)
    steps = np.diff(time)
    usual = float(np.median(steps))
    delay = None
    if samples.stamp is not None and samples.stamp is not samples.receive:
        delay = float(np.median(samples.receive - samples.stamp)) * 1e-9
    near = steps[(steps > 0) & (steps < 3 * usual)]
    return TopicReport(
        name=name,
        type=kind,
        count=len(samples.receive),
        rate=1 / usual if usual > 0 else None,
        longest_gap=float(steps.max()),
        jitter=float(near.std()) if len(near) else None,
        delay=delay,
        signals=signals,
    )


def _seconds(samples: Samples) -> Array:
    stamps = samples.receive if samples.stamp is None else samples.stamp
    return np.sort(np.asarray((stamps - stamps[0]) * 1e-9, dtype=np.float64))


def _clock(content: Content) -> Mapping[str, float]:
    clock = {}
    for name in ("reference_position", "rate_setpoint", "thrust_setpoint"):
        if name in content.series:
            grid = fit_grid(content.series[name].time, 100.0)
            if grid is not None:
                clock = {"spread": grid.spread, "drift": grid.drift}
                break
    offset = pose_offset(content.series)
    return clock if offset is None else {**clock, "pose_offset": offset}


def _mission(content: Content, index: int) -> MissionReport:
    mission = content.missions[index]
    clock = np.arange(mission.start, min(mission.end, mission.start + LOOKED_AT), 1 / RATE)
    position = resample("position", content.series["position"], clock)
    attitude = resample("attitude", content.series["attitude"], clock)
    speed = np.linalg.norm(derivative(smooth(position)), axis=1)
    up = rotate(attitude, np.tile([0.0, 0.0, 1.0], (len(clock), 1)))[:, 2]
    rates = content.series.get("body_rate")
    turning = None
    if rates is not None:
        turn_rates = np.linalg.norm(resample("body_rate", rates, clock), axis=1)
        turning = float(np.nanmax(turn_rates)) if np.isfinite(turn_rates).any() else None
    spin = yaw_spin(content.series.get("rate_setpoint"), mission.start, mission.end)
    known = np.isfinite(position).all(axis=1) & np.isfinite(attitude).all(axis=1)
    return MissionReport(
        start=mission.start,
        duration=mission.end - mission.start,
        begins_with=mission.begins_with,
        laps=_laps(content.series.get("lap"), mission.start, mission.end),
        mean_speed=_of(np.nanmean, speed),
        top_speed=_of(np.nanmax, speed),
        largest_tilt=float(np.degrees(np.arccos(np.clip(_of(np.nanmin, up), -1, 1)))),
        top_turn_rate=turning,
        yaw_rate_setpoint=None if spin is None else spin.yaw_rate,
        level_held=spin is not None and spin.level_held,
        height=(_of(np.nanmin, position[:, 2]), _of(np.nanmax, position[:, 2])),
        known=float(known.mean()),
        fitted=mission.fitted,
    )


def _of(reduce: object, values: Array) -> float:
    return float(reduce(values)) if np.isfinite(values).any() else float("nan")  # type: ignore[operator]


def _laps(lap: Series | None, start: float, end: float) -> int | None:
    if lap is None:
        return None
    return int(((lap.time >= start) & (lap.time <= end)).sum())

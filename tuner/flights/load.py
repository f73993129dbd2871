"""A recording file into `Flight`s: read, map, clean, synchronise, find the missions, resample."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tuner.errors import RecordingError
from tuner.flights.clean import clean
from tuner.flights.clock import Grid, fit_grid
from tuner.flights.extract import Raw, extract
from tuner.flights.flight import SIGNALS, Array, Flight, Note, Series
from tuner.flights.frames import correct_frames
from tuner.flights.initial import initial_state
from tuner.flights.locate import Place, choose_map, locate, require_pose
from tuner.flights.mission import Mission, find_missions, yaw_spin
from tuner.flights.opening import open_recording
from tuner.flights.recording import Recording, Samples, digest
from tuner.flights.resample import resample
from tuner.flights.sidecar import Sidecar, read_sidecar
from tuner.flights.sync import align_pose
from tuner.flights.topics import TopicMap, load_topic_map, shipped_maps

#: Seconds before the mission that the series keep.
BEFORE = 2.0
#: Seconds after it within which samples still help to interpolate its end.
AFTER = 0.2


@dataclass(frozen=True)
class Settings:
    """How a recording is to be read.

    Attributes
    ----------
    topics
        Topic map, its file, or the name of a shipped one; None takes the shipped map that finds
        most signals.
    namespace
        Prefix of the recorded topics that the map does not have, as ``uav1``.
    rate
        Hz of the uniform clock.
    """

    topics: str | Path | TopicMap | None = None
    namespace: str = ""
    rate: float = 100.0


@dataclass(frozen=True)
class Content:
    """A recording once read: its signals cleaned, on one clock, and the missions in them.

    Attributes
    ----------
    recording
        The file.
    topic_map
        The map that was used.
    places
        Signal -> where it was found.
    samples
        Topic -> its messages as recorded.
    series
        Signal -> cleaned samples, in seconds since the first pose.
    epoch
        Nanoseconds of that first pose, by the recording's clock.
    missions
        What was flown.
    notes
        What was dropped, repaired or doubted.
    """

    recording: Recording
    topic_map: TopicMap
    places: Mapping[str, Place]
    samples: Mapping[str, Samples]
    series: Mapping[str, Series]
    epoch: int
    missions: tuple[Mission, ...]
    notes: tuple[Note, ...]


def read_content(path: Path, settings: Settings, sidecar: Sidecar) -> Content:
    """Read a recording up to its missions.

    Raises
    ------
    RecordingError
        The file cannot be read or holds no pose.
    ConfigError
        The topic map is wrong.
    """
    topics = settings.topics or sidecar.topics
    given = load_topic_map(topics) if isinstance(topics, str | Path) else topics
    recording = open_recording(path, given.messages if given is not None else ())
    namespace = settings.namespace or sidecar.namespace
    candidates = [given] if given is not None else list(shipped_maps())
    candidates = [one.under(namespace) for one in candidates]
    if all(one.format != recording.format for one in candidates):
        raise RecordingError(
            path,
            f"is read as '{recording.format}', the topic map '{candidates[0].name}' is for "
            f"'{candidates[0].format}'",
            "give a map for this format",
        )
    chosen = choose_map(recording, candidates)
    places, notes = locate(recording, chosen)
    require_pose(recording, chosen, places)
    raw, samples, noticed = extract(recording, places, chosen.clocks)
    said = [
        Note("info", "", f"topic map '{chosen.name}' finds {len(places)} signals", len(places)),
        *notes,
        *noticed,
    ]
    series, epoch = _clean(path, raw, said)
    topics_of = {signal: data.topic for signal, data in raw.items()}
    series, noticed = align_pose(series, topics_of)
    said.extend(noticed)
    series, noticed = correct_frames(series, topics_of)
    said.extend(noticed)
    said.extend(_unmeasured(series, topics_of))
    missions = _missions(series, sidecar)
    return Content(recording, chosen, places, samples, series, epoch, missions, tuple(said))


def _clean(path: Path, raw: Mapping[str, Raw], said: list[Note]) -> tuple[dict[str, Series], int]:
    epoch = min((int(raw[name].time.min()) for name in ("position",) if name in raw), default=0)
    series = {}
    for signal, data in raw.items():
        seconds = np.asarray((data.time - epoch) * 1e-9, dtype=np.float64)
        time, values, found = clean(signal, data.topic, seconds, data.values)
        said.extend(found)
        if len(time):
            series[signal] = Series(time, values)
    for needed in ("position", "attitude"):
        if needed not in series:
            topic = raw[needed].topic if needed in raw else needed
            raise RecordingError(path, f"no usable {needed} in {topic}", "inspect the recording")
    return series, epoch


def _unmeasured(series: Mapping[str, Series], topics: Mapping[str, str]) -> list[Note]:
    """Say which rotors have no tachometer."""
    if "rotor_speed" not in series:
        return []
    missing = np.flatnonzero(np.isnan(series["rotor_speed"].values).all(axis=0))
    if len(missing) == 0:
        return []
    text = f"rotors {', '.join(str(rotor) for rotor in missing)} have no tachometer"
    return [Note("info", topics["rotor_speed"], text, len(missing))]


def _missions(series: Mapping[str, Series], sidecar: Sidecar) -> tuple[Mission, ...]:
    if sidecar.start is None and sidecar.end is None:
        return find_missions(series)
    end = float(series["position"].time[-1])
    start = sidecar.start if sidecar.start is not None else 0.0
    return (Mission(start, min(end, sidecar.end or end), "the side-car"),)


def make_flight(
    path: Path, content: Content, index: int, *, sha256: str, sidecar: Sidecar, rate: float
) -> Flight:
    """Put one mission of a recording on its uniform clock.

    Raises
    ------
    RecordingError
        The mission is shorter than two ticks.
    """
    mission = content.missions[index]
    series = content.series
    grid = _mission_grid(series, mission, rate)
    start = grid.tick_nearest(mission.start) if grid else mission.start
    count = math.floor((mission.end - start) * rate + 1e-6) + 1
    if count < 2:
        raise RecordingError(path, "its mission ends where it starts", "inspect the recording")
    clock = np.arange(count) / rate
    # Beyond the last tick, so that it has a sample on either side.
    around = {name: _from_start(data, start, mission.end + AFTER) for name, data in series.items()}
    own = {name: _until(data, mission.end - start) for name, data in around.items()}
    own = {name: data for name, data in own.items() if len(data.time)}
    ticks = Grid(grid.origin - start, rate, grid.drift, grid.spread) if grid else None
    notes = list(content.notes)
    if grid is not None and grid.drift:
        text = f"the publisher's clock drifts by {1e6 * grid.drift:+.0f} ppm against its stamps"
        notes.append(Note("info", "", text))
    if len(content.missions) > 1:
        text = f"mission {index + 1} of {len(content.missions)} in this recording"
        notes.append(Note("info", "", text, len(content.missions)))
    rates = own.get("rate_setpoint")
    return Flight(
        name=path.stem if index == 0 else f"{path.stem}-{index + 1}",
        path=str(path),
        sha256=sha256,
        rate=rate,
        time=clock,
        signals={name: _on_clock(name, around[name], clock, ticks) for name in own},
        series=own,
        initial=initial_state(around),
        yaw_rate_setpoint=yaw_spin(rates, 0.0, float(clock[-1])) if rates is not None else None,
        trajectory=sidecar.trajectory,
        notes=tuple(notes),
    )


def _mission_grid(series: Mapping[str, Series], mission: Mission, rate: float) -> Grid | None:
    """Fit the uniform clock to the reference or, where there is none, to the set-points."""
    for name in ("reference_position", "rate_setpoint", "thrust_setpoint"):
        if name in series:
            time = series[name].time
            near = time[(time >= mission.start - BEFORE) & (time <= mission.end)]
            grid = fit_grid(near, rate)
            if grid is not None:
                return grid
    return None


def _from_start(series: Series, start: float, end: float) -> Series:
    kept = (series.time >= start - BEFORE) & (series.time <= end + 1e-6)
    return Series(series.time[kept] - start, series.values[kept])


def _until(series: Series, end: float) -> Series:
    kept = series.time <= end + 1e-6
    return Series(series.time[kept], series.values[kept])


def _on_clock(signal: str, series: Series, clock: Array, grid: Grid | None) -> Array:
    if grid is not None and SIGNALS[signal][2] == "hold" and len(series.time) > 1:
        series = Series(grid.snap(series.time), series.values)
    return resample(signal, series, clock)


def load_flights(
    path: str | Path,
    *,
    topics: str | Path | TopicMap | None = None,
    namespace: str = "",
    rate: float = 100.0,
) -> tuple[Flight, ...]:
    """Read every mission of a recording; see `load_flight`."""
    path = Path(path)
    settings = Settings(topics, namespace, rate)
    sidecar = read_sidecar(path)
    content = read_content(path, settings, sidecar)
    if not content.missions:
        raise RecordingError(
            path,
            "nothing flies in it: no mission was found",
            "inspect it, or give 'start' and 'end' in a side-car",
        )
    sha256 = digest(path)
    return tuple(
        make_flight(path, content, index, sha256=sha256, sidecar=sidecar, rate=rate)
        for index in range(len(content.missions))
    )


def load_flight(
    path: str | Path,
    *,
    topics: str | Path | TopicMap | None = None,
    namespace: str = "",
    rate: float = 100.0,
    mission: int = 1,
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
        Which mission, from 1, of a recording that holds several.

    Raises
    ------
    RecordingError
        The file cannot be read, or it holds no pose or no such mission.
    ConfigError
        The topic map or the side-car is wrong.
    """
    flights = load_flights(path, topics=topics, namespace=namespace, rate=rate)
    if not 1 <= mission <= len(flights):
        raise RecordingError(
            path, f"holds {len(flights)} missions, not {mission}", "name one of those"
        )
    return flights[mission - 1]

"""What a recording holds: its signals cleaned and on one clock, and the missions in them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tuner.errors import RecordingError
from tuner.flights.clean import clean
from tuner.flights.damage import Damage
from tuner.flights.extract import Raw, extract
from tuner.flights.flight import Note, Series
from tuner.flights.formats import open_recording
from tuner.flights.frames import correct_frames
from tuner.flights.locate import Place, choose_map, locate, require_pose
from tuner.flights.mission import Mission, find_missions
from tuner.flights.recording import Recording, Samples
from tuner.flights.sidecar import Sidecar, sidecar_path
from tuner.flights.sync import align_pose
from tuner.flights.topics import TopicMap, load_topic_map, shipped_maps


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
    damage
        What the file has lost, with times as those of `series`.
    """

    recording: Recording
    topic_map: TopicMap
    places: Mapping[str, Place]
    samples: Mapping[str, Samples]
    series: Mapping[str, Series]
    epoch: int
    missions: tuple[Mission, ...]
    notes: tuple[Note, ...]
    damage: tuple[Damage, ...]


def read_content(
    path: Path, settings: Settings, sidecar: Sidecar, given: TopicMap | None
) -> Content:
    """Read a recording up to its missions.

    Parameters
    ----------
    path
        The recording.
    settings, sidecar
        How to read it.
    given
        The topic map that the user or the side-car names; None tries the shipped ones.

    Raises
    ------
    RecordingError
        The file cannot be read or holds no pose.
    ConfigError
        The topic map is wrong.
    """
    recording = open_recording(path, given.messages if given is not None else ())
    namespace = settings.namespace or sidecar.namespace
    candidates = [given] if given is not None else list(shipped_maps())
    candidates = [candidate.under(namespace) for candidate in candidates]
    if all(candidate.format != recording.format for candidate in candidates):
        raise RecordingError(
            path,
            f"is read as '{recording.format}', the topic map '{candidates[0].name}' is for "
            f"'{candidates[0].format}'",
            "give a map for this format",
        )
    chosen = choose_map(recording, candidates)
    places, notes = locate(recording, chosen, strict=given is not None)
    require_pose(recording, chosen, places)
    raw, contents, noticed = extract(recording, places, chosen.time)
    all_notes = [
        Note("info", "", f"topic map '{chosen.name}' finds {len(places)} signals", len(places)),
        *notes,
        *contents.notes,
        *noticed,
    ]
    series, epoch = _clean(path, raw, all_notes)
    # From the recorder's clock to that of the stamps, in which the series are.
    arrival = contents.samples[raw["position"].topic].receive
    later = float(np.median(raw["position"].time)) - float(np.median(arrival)) - epoch
    damage = tuple(part.later(later * 1e-9) for part in contents.damage)
    topics_of = {signal: data.topic for signal, data in raw.items()}
    series, noticed = align_pose(series, topics_of)
    all_notes.extend(noticed)
    series, noticed = correct_frames(series, topics_of)
    all_notes.extend(noticed)
    all_notes.extend(_unmeasured(series, topics_of))
    missions = _missions(series, sidecar)
    return Content(
        recording,
        chosen,
        places,
        contents.samples,
        series,
        epoch,
        missions,
        tuple(all_notes),
        damage,
    )


def given_map(path: Path, settings: Settings, sidecar: Sidecar) -> TopicMap | None:
    """Return the topic map that the user or, failing that, the side-car names.

    Raises
    ------
    ConfigError
        It is wrong.
    """
    if settings.topics is None and sidecar.topics is not None:
        return load_topic_map(sidecar.topics, base=sidecar_path(path).parent)
    if isinstance(settings.topics, str | Path):
        return load_topic_map(settings.topics)
    return settings.topics


def _clean(
    path: Path, raw: Mapping[str, Raw], all_notes: list[Note]
) -> tuple[dict[str, Series], int]:
    epoch = int(raw["position"].time.min()) if "position" in raw else 0
    series = {}
    for signal, data in raw.items():
        seconds = np.asarray((data.time - epoch) * 1e-9, dtype=np.float64)
        time, values, dropped = clean(signal, data.topic, seconds, data.values)
        all_notes.extend(dropped)
        if len(time):
            series[signal] = Series(time, values)
    for needed in ("position", "attitude"):
        if needed not in series:
            where = f" in {raw[needed].topic}" if needed in raw and raw[needed].topic else ""
            raise RecordingError(path, f"no usable {needed}{where}", "inspect the recording")
    return series, epoch


def _unmeasured(series: Mapping[str, Series], topics: Mapping[str, str]) -> list[Note]:
    """Note which rotors have no tachometer."""
    if "rotor_speed" not in series:
        return []
    missing = np.flatnonzero(np.isnan(series["rotor_speed"].values).all(axis=0))
    if len(missing) == 0:
        return []
    text = f"rotors {', '.join(str(rotor) for rotor in missing)} have no tachometer"
    return [Note("info", topics["rotor_speed"], text, len(missing))]


def _missions(series: Mapping[str, Series], sidecar: Sidecar) -> tuple[Mission, ...]:
    missions = find_missions(series)
    if sidecar.start is None and sidecar.end is None:
        return missions
    pose = series["position"].time
    start = missions[0].start if missions else float(pose[0])
    end = missions[-1].end if missions else float(pose[-1])
    start = start if sidecar.start is None else max(sidecar.start, float(pose[0]))
    end = end if sidecar.end is None else min(sidecar.end, float(pose[-1]))
    return (Mission(start, end, "the side-car"),) if end > start else ()

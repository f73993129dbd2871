"""Find each signal's source in a recording, and name the near misses of those not there."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase

from tuner.errors import RecordingError
from tuner.flights.flight import Note
from tuner.flights.recording import Recording
from tuner.flights.topics import Source, TopicMap


@dataclass(frozen=True)
class Place:
    """Where a signal will be read: its source, with topic, fields, unit and axes filled in."""

    source: Source
    topic: str
    fields: tuple[str, ...]
    unit: str
    frame: str


def choose_map(recording: Recording, candidates: Iterable[TopicMap]) -> TopicMap:
    """Return the map that finds most signals in a recording, then the one of higher priority."""
    suited = [one for one in candidates if one.format == recording.format]
    return max(suited, key=lambda one: (len(_found(recording, one)), one.priority))


def _found(recording: Recording, topics: TopicMap) -> dict[str, Place]:
    try:
        return locate(recording, topics)[0]
    except RecordingError:  # a map that does not fit
        return {}


def locate(recording: Recording, topics: TopicMap) -> tuple[dict[str, Place], tuple[Note, ...]]:
    """Return, for each signal of a map, the first source that the recording has.

    Raises
    ------
    RecordingError
        A topic is there, but nobody says where it holds the signal.
    """
    if topics.time and not any(recording.holds("", (c.field,)) for c in topics.clocks):
        return {}, ()
    places: dict[str, Place] = {}
    notes = []
    for signal, sources in topics.signals.items():
        for source in sources:
            matching = _matching(recording, source.topic)
            if not matching:
                continue
            topic = matching[0]
            usual = recording.usual(topic, signal)
            fields = source.fields or (usual.fields if usual else None)
            if fields is None:
                kind = next(known.type for known in recording.topics if known.name == topic)
                raise RecordingError(
                    recording.path,
                    f"it is not known where {topic} ({kind}) holds the {signal}",
                    "name the 'fields' in the topic map",
                )
            if not recording.holds(topic, fields):
                continue
            if len(matching) > 1:
                text = f"{signal} from {topic}; {', '.join(matching[1:4])} would also match"
                notes.append(Note("warning", topic, text, len(matching) - 1))
            unit = source.unit or (usual.unit if usual and not source.fields else "si")
            frame = source.frame or (usual.frame if usual else "enu_flu")
            places[signal] = Place(source, topic, fields, unit, frame)
            break
    return places, tuple(notes)


def _matching(recording: Recording, pattern: str) -> list[str]:
    """Return the recorded topics of a name or pattern, the one with most messages first."""
    if "*" not in pattern:
        known = [topic for topic in recording.topics if topic.name == pattern and topic.count]
    else:
        known = [t for t in recording.topics if t.count and fnmatchcase(t.name, pattern)]
    return [topic.name for topic in sorted(known, key=lambda t: (-t.count, t.name))]


def require_pose(recording: Recording, topics: TopicMap, found: Mapping[str, Place]) -> None:
    """Raise a `RecordingError` with the nearest topic names if a pose is missing."""
    missing = [signal for signal in ("position", "attitude") if signal not in found]
    if not missing:
        return
    what = " and ".join(missing)
    sources = [source for signal in missing for source in topics.signals.get(signal, ())]
    if not sources:
        raise RecordingError(
            recording.path, f"the topic map '{topics.name}' names no topic for {what}", "add one"
        )
    if recording.format == "table":
        columns = [name for source in sources for name in source.fields or ()]
        raise RecordingError(
            recording.path,
            f"the topic map '{topics.name}' finds no {what}: no columns {', '.join(columns)}",
            "give a topic map for these columns (--topics FILE)",
        )
    names = [topic.name for topic in recording.topics if topic.count]
    wanted = list(dict.fromkeys(source.topic for source in sources))
    for topic in wanted:
        for name in names:
            if name.endswith(topic) and name != topic:
                raise RecordingError(
                    recording.path,
                    f"no topic {topic}; found {name}",
                    f"use --namespace {name[: -len(topic)].strip('/')}",
                )
    near = [n for topic in wanted for n in difflib.get_close_matches(topic, names, n=2, cutoff=0.6)]
    listed = ", ".join(dict.fromkeys(near)) if near else ", ".join(names[:12]) or "nothing at all"
    raise RecordingError(
        recording.path,
        f"no topic {' or '.join(wanted)} for {what}; "
        f"{'similar are' if near else 'it holds'} {listed}",
        "name the right one in a topic map (--topics FILE)",
    )

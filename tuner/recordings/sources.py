"""Find each signal's source in a recording, and name the near misses of those not there."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase

from tuner.core.errors import RecordingError
from tuner.recordings.columns import recognised
from tuner.recordings.formats import is_tabular
from tuner.recordings.notes import Note, NoteCode, reason_in_words
from tuner.recordings.recording import Recording
from tuner.recordings.topics import Source, TopicMap

NAMED = 12
"""Columns that a note names, at most."""


@dataclass(frozen=True)
class Place:
    """Where a signal will be read: its source, with topic, fields, unit and axes filled in."""

    source: Source
    topic: str
    fields: tuple[str, ...]
    unit: str
    frame: str


def choose_map(recording: Recording, candidates: Iterable[TopicMap]) -> TopicMap:
    """Return the map that finds a pose and most signals, then the one of higher priority."""
    suited = [topic_map for topic_map in candidates if topic_map.format == recording.format]

    def signals_found(topic_map: TopicMap) -> tuple[int, int, int]:
        places = locate(recording, topic_map)[0]
        return len({"position", "attitude"} & set(places)), len(places), topic_map.priority

    return max(suited, key=signals_found)


def locate(
    recording: Recording, topics: TopicMap, *, strict: bool = False
) -> tuple[dict[str, Place], tuple[Note, ...]]:
    """Return, for each signal of a map, the first source that the recording has.

    Parameters
    ----------
    recording
        An open recording.
    topics
        The map.
    strict
        Whether a user wrote the map, so that a topic without the fields named is an error;
        otherwise such a topic is passed over with a note.

    Raises
    ------
    RecordingError
        If `strict`: a topic is there, but not what the map says of it.
    """
    times = [recording.lacking("", (clock.field,)) for clock in topics.time]
    if is_tabular(recording.format) and all(times):
        return {}, ()
    places: dict[str, Place] = {}
    notes = []
    for signal, sources in topics.signals.items():
        for source in sources:
            attempts = [_place(recording, signal, source, t) for t in _matching(recording, source)]
            good = [place for place in attempts if isinstance(place, Place)]
            if good:
                if len(good) > 1:
                    names = (signal, *(place.topic for place in good[1:4]))
                    more, topic = len(good) - 1, good[0].topic
                    notes.append(Note(NoteCode.OTHERS_MATCH, "warning", topic, more, names=names))
                places[signal] = good[0]
                break
            refusal = next((found for found in attempts if isinstance(found, Note)), None)
            if refusal and strict:
                what = reason_in_words(refusal)
                raise RecordingError(recording.path, what, "correct the topic map")
            if refusal:
                notes.append(refusal)
    return places, tuple(notes)


def _matching(recording: Recording, source: Source) -> list[str]:
    """Return the recorded topics of a name or pattern, the one with most messages first."""
    pattern = source.topic
    alike = fnmatchcase if "*" in pattern else str.__eq__
    known = [topic for topic in recording.topics if topic.count and alike(topic.name, pattern)]
    return [topic.name for topic in sorted(known, key=lambda t: (-t.count, t.name))]


def _place(recording: Recording, signal: str, source: Source, topic: str) -> Place | Note | None:
    """Return where a topic holds a signal, or why it does not: None if nobody expects it to."""
    usual = recording.usual(topic, signal)
    fields = source.fields or (usual.fields if usual else None)
    if fields is None:
        kind = next(known.type for known in recording.topics if known.name == topic)
        wild = "*" in source.topic
        return None if wild else Note(NoteCode.LAYOUT_UNKNOWN, topic=topic, names=(kind, signal))
    missing = recording.lacking(topic, fields)
    if missing:
        # nobody expects a table, or any topic whatsoever, to hold all that a map knows
        anywhere = is_tabular(recording.format) or source.topic == "*"
        absent = anywhere and len(missing) == len(fields)
        near = difflib.get_close_matches(missing[0], recording.fields(topic), n=1)
        names = (missing[0], signal, *near)
        return None if absent else Note(NoteCode.FIELD_MISSING, topic=topic, names=names)
    unit = source.unit or (usual.unit if usual and not source.fields else "si")
    return Place(source, topic, fields, unit, source.frame or (usual.frame if usual else "enu_flu"))


def unread(recording: Recording, topics: TopicMap, places: Mapping[str, Place]) -> tuple[Note, ...]:
    """Return a note on the columns of a table that hold no signal and no time, if there are any.

    A column under another name than the map's would be missed in silence otherwise.
    """
    if not is_tabular(recording.format):
        return ()
    read = {field for place in places.values() for field in place.fields}
    read |= {clock.field for clock in topics.time}
    columns = [name for topic in recording.topics for name in recording.fields(topic.name)]
    others = tuple(name for name in columns if name not in read)
    note = Note(NoteCode.COLUMNS_UNREAD, "info", count=len(others), names=others[:NAMED])
    return (note,) if others else ()


def with_guesses(recording: Recording, topics: TopicMap) -> tuple[TopicMap, tuple[Note, ...]]:
    """Return a map of a table with the columns that it lacks and whose names say what they hold.

    Returns
    -------
    tuple
        The map, and a note for each signal that was added.
    """
    if not is_tabular(recording.format):
        return topics, ()
    columns = recording.fields("")
    time, found = recognised(columns, recording.units)
    held = locate(recording, topics)[0]
    if not {"position", "attitude"} <= set(held) and len(found) + bool(time) > len(held):
        topics = topics.replace(name="the columns' names", time=(), signals={})
    times = topics.time
    if time is not None and not any(clock.field in columns for clock in times):
        times = (time,)
    whole = topics.replace(time=times)
    places, _ = locate(recording, whole)
    taken = {field for place in places.values() for field in place.fields}
    signals, notes = dict(topics.signals), []
    for signal, source in found.items():
        fields = source.fields or ()
        if signal not in places and not taken & set(fields):
            signals[signal] = (source,)
            notes.append(Note(NoteCode.COLUMNS_TAKEN, "info", names=(signal, *fields)))
    return whole.replace(signals=signals), tuple(notes)


def _obstacle(recording: Recording, topics: TopicMap, what: str, *, given: bool) -> tuple[str, str]:
    """Return why a table holds no pose, and what to do."""
    columns = recording.fields("")
    if recording.obstacle is not None and not given:
        return recording.obstacle
    listed = f"{', '.join(columns[:NAMED])}{', ...' if len(columns) > NAMED else ''}"
    clocks = [clock.field for clock in topics.time]
    if not any(field in columns for field in clocks):
        named = f"the topic map '{topics.name}' finds no time: no column {' or '.join(clocks)}"
        return (
            named if given else f"has no column that is a time among {listed}",
            "name it under 'time' in a topic map (--topics FILE)",
        )
    if given:
        sources = [
            source for name in what.split(" and ") for source in topics.signals.get(name, ())
        ]
        wanted = (
            ", ".join(name for source in sources for name in source.fields or ()) or "are named"
        )
        return (
            f"the topic map '{topics.name}' finds no {what}: no columns {wanted}",
            "correct it: tune inspect FILE --suggest writes one for these columns",
        )
    return (
        f"has no columns that by their names are its {what}, among {listed}",
        "name them in a topic map (--topics FILE), which tune inspect FILE --suggest begins",
    )


def _require_definitions(recording: Recording, signals: Iterable[str]) -> None:
    """Raise if topics would hold some signals, but the definitions of their types are missing."""
    for topic in recording.topics:
        holds = topic.count and any(recording.usual(topic.name, signal) for signal in signals)
        if holds and recording.undefined(topic.name) is not None:
            raise RecordingError(
                recording.path,
                f"holds {topic.name}, but not the definition of its type {topic.type}, which "
                "databases of ROS 2 Humble and before do not",
                "name the folder of its package's .msg files under 'messages' in a topic map "
                "(extends: px4_ros2), or convert the recording to MCAP",
            )


def require_pose(
    recording: Recording, topics: TopicMap, places: Mapping[str, Place], *, given: bool = False
) -> None:
    """Raise a `RecordingError` with the nearest topic names if a pose is missing.

    Parameters
    ----------
    recording, topics, places
        As of `locate`.
    given
        Whether a user wrote the map.
    """
    missing = [signal for signal in ("position", "attitude") if signal not in places]
    if not missing:
        return
    what = " and ".join(missing)
    if is_tabular(recording.format):
        raise RecordingError(recording.path, *_obstacle(recording, topics, what, given=given))
    sources = [source for signal in missing for source in topics.signals.get(signal, ())]
    if not sources:
        raise RecordingError(
            recording.path, f"the topic map '{topics.name}' names no topic for {what}", "add one"
        )
    _require_definitions(recording, missing)
    names = [topic.name for topic in recording.topics if topic.count]
    if all(source.topic == "*" for source in sources):
        held = [field for name in names for field in recording.fields(name)]
        raise RecordingError(
            recording.path,
            f"holds no {what}, only {', '.join(held[:12]) or 'nothing'}",
            "log the vehicle's estimate of it, or motion capture; body rate, acceleration and "
            "motor commands are fitted without one, by themselves (tune --flights)",
        )
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
        f"no topic {' or '.join(wanted[:4])} for {what}; "
        f"{'similar are' if near else 'it holds'} {listed}",
        "name the right one in a topic map (--topics FILE)",
    )

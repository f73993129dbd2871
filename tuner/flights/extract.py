"""Recorded fields into signals: pick each signal's source, its stamps, its unit and frame."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tuner.errors import RecordingError
from tuner.flights.flight import SIGNALS, Array, Note
from tuner.flights.recording import Nanoseconds, Recording, Samples
from tuner.flights.topics import Source, TopicMap
from tuner.flights.units import to_enu_flu, to_si

#: A header this far from the time of recording was stamped by a clock that is not set.
UNSET_CLOCK = 3600 * 1_000_000_000


@dataclass(frozen=True)
class Raw:
    """One signal as recorded, in SI units and the axes of a `Flight`.

    Attributes
    ----------
    topic
        Where it comes from.
    time
        (n,) ns; in the order of the file, with its defects.
    values
        (n, k) in the columns of `SIGNALS`; NaN where not measured.
    """

    topic: str
    time: Nanoseconds
    values: Array


@dataclass(frozen=True)
class Place:
    """Where a signal will be read: its source, with fields and unit filled in."""

    source: Source
    fields: tuple[str, ...]
    unit: str


def locate(recording: Recording, topics: TopicMap) -> dict[str, Place]:
    """Return, for each signal of a map, the first source that the recording has."""
    counts = {topic.name: topic.count for topic in recording.topics}
    places = {}
    for signal, sources in topics.signals.items():
        for source in sources:
            if not counts.get(source.topic):
                continue
            usual = recording.usual(source.topic, signal)
            fields = source.fields or (usual.fields if usual else None)
            if fields is None:
                kind = next(t.type for t in recording.topics if t.name == source.topic)
                raise RecordingError(
                    recording.path,
                    f"it is not known where {source.topic} ({kind}) holds the {signal}",
                    "name the 'fields' in the topic map",
                )
            unit = source.unit or (usual.unit if usual and not source.fields else "si")
            places[signal] = Place(source, fields, unit)
            break
    return places


def require_pose(recording: Recording, topics: TopicMap, found: Mapping[str, Place]) -> None:
    """Raise a `RecordingError` with the nearest topic names if a pose is missing."""
    missing = [signal for signal in ("position", "attitude") if signal not in found]
    if not missing:
        return
    wanted = [source.topic for signal in missing for source in topics.signals.get(signal, ())]
    if not wanted:
        raise RecordingError(
            recording.path,
            f"the topic map '{topics.name}' names no topic for {' and '.join(missing)}",
            "add one",
        )
    names = [topic.name for topic in recording.topics if topic.count]
    for topic in wanted:
        for name in names:
            if name.endswith(topic) and name != topic:
                space = name[: -len(topic)].strip("/")
                raise RecordingError(
                    recording.path,
                    f"no topic {topic}; found {name}",
                    f"use --namespace {space}",
                )
    near = [n for topic in wanted for n in difflib.get_close_matches(topic, names, n=2, cutoff=0.6)]
    listed = ", ".join(near or names[:12]) or "nothing at all"
    raise RecordingError(
        recording.path,
        f"no topic {' or '.join(dict.fromkeys(wanted))} for {' and '.join(missing)}; "
        f"{'similar are' if near else 'it holds'} {listed}",
        "name the right one in a topic map (--topics FILE)",
    )


def extract(
    recording: Recording, places: Mapping[str, Place]
) -> tuple[dict[str, Raw], tuple[Note, ...]]:
    """Read every located signal."""
    wanted: dict[str, list[str]] = {}
    for place in places.values():
        fields = wanted.setdefault(place.source.topic, [])
        extra = [place.source.rotor] if place.source.rotor else []
        fields.extend(name for name in (*place.fields, *extra) if name not in fields)
    contents = recording.read(wanted)
    notes = list(contents.notes)
    signals = {}
    for signal, place in places.items():
        samples = contents.samples.get(place.source.topic)
        if samples is None or len(samples.receive) == 0:
            continue
        time, note = _clock(samples, place.source)
        if note is not None and note not in notes:
            notes.append(note)
        signals[signal] = Raw(place.source.topic, time, _values(samples, signal, place))
    return signals, tuple(notes)


def _clock(samples: Samples, source: Source) -> tuple[Nanoseconds, Note | None]:
    """Return the stamps to believe: the header's, unless there is none or its clock is not set."""
    if source.stamp == "receive":
        return samples.receive, None
    if samples.stamp is None:
        text = "has no header: its times are those of recording"
        return samples.receive, Note("info", source.topic, text, len(samples.receive))
    off = np.abs(samples.stamp - samples.receive) > UNSET_CLOCK
    if off.mean() > 0.5:
        text = "header stamps are unset or hours away: the times of recording are used"
        return samples.receive, Note("warning", source.topic, text, int(off.sum()))
    return samples.stamp, None


def _values(samples: Samples, signal: str, place: Place) -> Array:
    columns, _, _ = SIGNALS[signal]
    fields: Sequence[str] = place.fields
    if signal == "attitude" and place.source.quaternion == "xyzw":
        fields = (fields[3], *fields[:3])
    values = to_si(np.column_stack([samples.fields[name] for name in fields]), place.unit)
    if place.source.rotor is not None:
        rotor = samples.fields[place.source.rotor]
        spread = np.full((len(values), columns), np.nan)
        for column in range(columns):
            of_this = rotor == column
            spread[of_this, column] = values[of_this, 0]
        return spread
    if place.source.frame == "ned_frd":
        values = to_enu_flu(values, signal)
    return np.asarray(values, dtype=np.float64)

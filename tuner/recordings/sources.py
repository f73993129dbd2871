"""Find each signal's source in a recording, and suggest similar names for those missing.

A table's columns are also recognised by the words of their names: ``pose.position.x [mm]``,
``/vrpn/quad/pose/position/x``, ``posX_mm`` and ``field.pose.position.x`` all mean position, x, and
some a unit. Units that the words leave open are inferred from physics later, or asked for.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

from tuner.core.errors import RecordingError
from tuner.recordings.flight import SIGNALS
from tuner.recordings.formats import is_tabular
from tuner.recordings.notes import Note, NoteCode, note_text
from tuner.recordings.recording import Clock, Recording
from tuner.recordings.topics import Source, TopicMap
from tuner.recordings.unit_detection import UNITS

TIME_UNITS: Mapping[str, str] = {
    "s": "s sec secs seconds second",
    "ms": "ms msec milliseconds",
    "us": "us µs usec microseconds",
    "ns": "ns nsec nanoseconds",
}
"""Unit of times -> its spellings."""
_SPELLINGS = {name: unit.spellings for name, unit in UNITS.items()} | dict(TIME_UNITS)
UNIT_SPELLINGS = {word: unit for unit, words in _SPELLINGS.items() for word in words.split()}
"""Unit as written -> unit of a topic map."""

#: Words that mean each quantity.
_POSITION = {"position", "pos", "p", "translation", "xyz"}
_ATTITUDE = {"orientation", "quaternion", "quat", "q", "rotation", "attitude", "att", "rot"}
_VELOCITY = {"velocity", "vel", "v", "linear_velocity"}
_RATE = {"gyro", "angular_velocity", "body_rate", "bodyrate", "omega", "angvel", "w", "rate",
         "rates", "gyr", "angular"}  # fmt: skip
_FORCE = {"acc", "accel", "accelerometer", "acceleration", "linear_acceleration", "a", "imu_acc"}
_SPEED = {"rotor_speed", "rpm", "motor_speed", "rotorspeed", "motorspeed", "erpm", "motor_rpm",
          "rotor", "esc_rpm", "mot_speed", "omega_motor"}  # fmt: skip
_COMMAND = {"command", "cmd", "pwm", "motor", "mot", "throttle", "motors", "actuator", "u",
            "control", "output", "channels"}  # fmt: skip
_BATTERY = {"battery_voltage", "vbat", "voltage", "battery", "bat", "batt", "voltage_v"}
_TIME = {"time", "t", "timestamp", "stamp", "time_s", "seconds", "__time", "%time",
         "datetime", "date", "rosbagtimestamp", "clock", "elapsed"}  # fmt: skip
#: Signal -> words that mean it where its columns are numbered.
_NUMBERED_WORDS = {
    "attitude": _ATTITUDE,
    "position": _POSITION - {"xyz"},
    "velocity": _VELOCITY - {"v"},
    "body_rate": _RATE - {"w", "angular"},
    "acceleration": _FORCE - {"a"},
    "angles": {"euler", "rpy", "angles"},
}
#: Words of set-points, errors and other sensors: a column with one is no measured signal.
_NOT_MEASURED = {
    "setpoint", "sp", "ref", "reference", "target", "desired", "des", "cmdvel", "goal", "error",
    "err", "cov", "covariance", "std", "var", "variance", "bias", "raw_adc", "mag", "integral",
    "delta", "temperature", "temp", "current", "goalpose", "noise",
}  # fmt: skip
#: Words that name the body or the source, and no signal.
_NEUTRAL_WORDS = {
    "mocap", "vicon", "optitrack", "vrpn", "qualisys", "qtm", "drone", "quad", "uav", "cf",
    "vehicle", "body", "robot", "crazyflie", "pose", "state", "odom", "odometry", "out", "signals",
    "local", "world", "global", "marker", "rigid", "gt", "truth", "ground", "log", "sim",
    "measured", "meas",
}  # fmt: skip
_ESTIMATE_WORDS = {"est", "estimate", "estimated", "kalman", "ekf", "filtered"}


@dataclass(frozen=True)
class ColumnMeaning:
    """The meaning of a column's name.

    Attributes
    ----------
    signal
        Of `SIGNALS`, or ``time``, or ``angles``: an attitude in roll, pitch and yaw.
    axis
        Its column: ``x``, ``w``, ``roll`` or the number of a rotor from 1; empty of a single one.
    unit
        Of a topic map or of time; None if the name has none.
    group
        The words before, which the signal's columns share.
    """

    signal: str
    axis: str
    unit: str | None
    group: str


def split_unit(name: str) -> tuple[str, str | None]:
    """Return a name without its unit, in brackets or as the last word, and the unit."""
    match = re.fullmatch(r"(.*?)\s*[\[(]\s*([^\])]*)\s*[\])]", name)
    if match and not match[2].isdecimal():
        unit = UNIT_SPELLINGS.get(match[2].strip().lower().replace(" ", "").replace("_", "/"))
        return (match[1].strip(), unit) if unit or not match[2].strip() else (name, None)
    head, _, tail = name.rpartition("_")
    unit = UNIT_SPELLINGS.get(tail.lower())
    if head and unit and len(tail) > 1 and tail.lower() not in ("rpm", "pwm", "gs", "rads"):
        return head, unit
    return name, None


def column_meaning(name: str, written: str | None = None) -> ColumnMeaning | None:
    """Return the meaning of a column's name; None if it names no signal of a flight.

    Parameters
    ----------
    written
        Its unit in a row of units.
    """
    bare, unit = split_unit(name)
    if written is not None:
        unit = UNIT_SPELLINGS.get(written.strip("[]() ").lower(), unit)
    words = _words(bare)
    if not words or _NOT_MEASURED & set(words):
        return None
    whole = "_".join(words)
    last = re.split(r"[./]", bare.strip().lower())[-1]
    if whole in _TIME or last in _TIME:
        return ColumnMeaning("time", "", unit if unit in TIME_UNITS else None, "")
    unit = None if unit in TIME_UNITS else unit
    if words[-1] in ("roll", "pitch", "yaw") and not (_RATE & set(words[:-1])):
        return ColumnMeaning("angles", words[-1], unit, "_".join(words[:-1]))
    axis, rest = _axis(words)
    if axis is None:
        if whole in _BATTERY or (words[-1] in ("voltage", "vbat", "v") and _BATTERY & set(words)):
            return ColumnMeaning("battery_voltage", "", unit, "")
        return None
    return _meaning_of_axis(axis, rest, unit)


def _meaning_of_axis(axis: str, rest: list[str], unit: str | None) -> ColumnMeaning | None:
    """Return the meaning of the words before an axis or a rotor's number."""
    words = set(rest) | {"_".join(rest[i : i + 2]) for i in range(len(rest) - 1)}
    moving, turning = words & (_VELOCITY | {"twist"}), words & {"ang", "angular"}
    bare = {word for word in words if "_" not in word} <= _ESTIMATE_WORDS | _NEUTRAL_WORDS
    numbered: tuple[tuple[str, object], ...] = (
        ("rotor_speed", unit in ("rpm", "hz") or words & _SPEED),
        ("command", words & _COMMAND),
        *((signal, words & known) for signal, known in _NUMBERED_WORDS.items()),
    )
    along: tuple[tuple[str, object], ...] = (
        ("attitude", axis == "w" or words & _ATTITUDE),
        ("body_rate", words & (_RATE - {"angular"}) or (turning and moving)),
        ("acceleration", words & _FORCE and not turning),
        ("velocity", moving),
        ("position", words & _POSITION or bare),
    )
    rules = numbered if axis.isdecimal() else along
    signal = next((signal for signal, holds in rules if holds), None)
    if signal is None:
        return None
    if signal == "rotor_speed" and unit is None and any("rpm" in word for word in words):
        unit = "rpm"
    return ColumnMeaning(signal, axis, None if signal == "attitude" else unit, "_".join(rest))


def _words(name: str) -> list[str]:
    """Return a name's words in lower case, without the prefixes of containers."""
    text = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name.strip())
    text = re.sub(r"\[(\d+)\]", r"_\1", text)
    words = [word for word in re.split(r"[^0-9a-zA-Z%°]+", text.lower()) if word]
    return [word for word in words if word not in ("field", "header", "msg", "data", "value")]


def _axis(words: list[str]) -> tuple[str | None, list[str]]:
    """Return the axis or the rotor's number that a name ends or begins with, and the rest."""
    last = words[-1]
    if last in _ESTIMATE_WORDS and len(words) > 1:
        axis, rest = _axis(words[:-1])
        return axis, [*rest, last]
    if last in ("w", "x", "y", "z") or (last.isdecimal() and len(last) == 1 and len(words) > 1):
        return last, words[:-1]
    glued = re.fullmatch(r"(q|p|v|a|acc|gyro|w|omega|pos|vel|quat|gyr)_?([wxyz])", last)
    if glued:
        return glued[2], [*words[:-1], glued[1]]
    numbered = re.fullmatch(r"([a-z]+)([1-8])", last)
    if numbered and (numbered[1] in _COMMAND | _SPEED or numbered[1] in ("m", "w")):
        return numbered[2], [
            *words[:-1],
            {"m": "motor", "w": "rotor"}.get(numbered[1], numbered[1]),
        ]
    return None, words


#: Signal -> the axes of its columns, in their order.
AXES: Mapping[str, Sequence[str]] = {
    "position": ("x", "y", "z"),
    "velocity": ("x", "y", "z"),
    "attitude": ("w", "x", "y", "z"),
    "angles": ("roll", "pitch", "yaw"),
    "body_rate": ("x", "y", "z"),
    "acceleration": ("x", "y", "z"),
    "rotor_speed": ("1", "2", "3", "4"),
    "command": ("1", "2", "3", "4"),
    "battery_voltage": ("",),
}


def sources_by_name(
    columns: Sequence[str], units: Mapping[str, str]
) -> tuple[Clock | None, dict[str, Source]]:
    """Return the time, and the signals, of a table's columns by their names.

    Parameters
    ----------
    units
        Column -> unit, from a row of units.
    """
    guesses = {
        name: g for name in columns if (g := column_meaning(name, units.get(name))) is not None
    }
    times = [name for name, g in guesses.items() if g.signal == "time"]
    stamps = [name for name in times if name.endswith("header.stamp")]  # rather than of recording
    time = next(iter((*stamps, *times)), None)
    found: dict[str, Source] = {}
    for signal, axes in AXES.items():
        groups: dict[str, dict[str, str]] = {}
        for name, g in guesses.items():
            if g.signal == signal:
                groups.setdefault(g.group, {}).setdefault(g.axis, name)
        for _, held in sorted(groups.items(), key=lambda item: _group_rank(item[0])):
            count = range(len(axes))
            ways = (axes, [str(i) for i in count], [str(i + 1) for i in count])
            numbers = {axis for axis in held if axis.isdecimal()}
            wanted = next(
                (way for way in ways if set(way) <= set(held) and numbers <= set(way)), None
            )
            if wanted is not None:
                names = tuple(held[axis] for axis in wanted)
                written = {guesses[name].unit for name in names}
                unit = written.pop() if len(written) == 1 else None
                if signal == "angles":
                    angles = Source(fields=names, unit=unit, quaternion="rpy")
                    found.setdefault("attitude", angles)
                else:
                    found[signal] = Source(fields=names, unit=unit)
                break
    known = None if time is None else {"field": time, "unit": guesses[time].unit}
    return None if known is None else Clock.model_validate(known), found


def _group_rank(group: str) -> tuple[bool, int]:
    """Return the sort key of groups of columns: measured before estimated, short before long."""
    return bool(_ESTIMATE_WORDS & set(group.split("_"))), len(group)


MAX_NAMED = 12
"""A note names at most so many columns."""


@dataclass(frozen=True)
class Place:
    """The source of a signal with topic, fields, unit and axes filled in.

    The fields are in the order of the signal's columns.
    """

    source: Source
    topic: str
    fields: tuple[str, ...]
    unit: str
    frame: str

    @property
    def read(self) -> tuple[str, ...]:
        """The fields, and that which names a message's rotor, if one does."""
        return self.fields if self.source.rotor is None else (*self.fields, self.source.rotor)


def choose_map(recording: Recording, candidates: Iterable[TopicMap]) -> TopicMap:
    """Return the map that finds a pose and most signals, then the one of higher priority.

    Raises
    ------
    RecordingError
        No map is for its format.
    """
    suited = [topic_map for topic_map in candidates if topic_map.format == recording.format]
    if not suited:
        what = f"is read as '{recording.format}', for which no topic map ships"
        raise RecordingError(recording.path, what, "give one with --topics")

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
    strict
        Whether a topic without the named fields is an error, as in a user's map, rather than
        passed over with a note.

    Raises
    ------
    RecordingError
        If `strict`: a topic lacks the named fields.
    """
    times = [recording.missing_fields("", (clock.field,)) for clock in topics.time]
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
                    taken, *others = (place.topic for place in good)
                    notes.append(
                        NoteCode.OTHERS_MATCH.note(
                            signal, *others[:3], topic=taken, count=len(others)
                        )
                    )
                places[signal] = good[0]
                break
            refusal = next((found for found in attempts if isinstance(found, Note)), None)
            if refusal and strict:
                what = note_text(refusal)
                raise RecordingError(recording.path, what, "correct the topic map")
            if refusal:
                notes.append(refusal)
    return places, tuple(notes)


def _matching(recording: Recording, source: Source) -> list[str]:
    """Return the topics of a name or pattern, the one with most messages first."""
    pattern = source.topic
    alike = fnmatchcase if "*" in pattern else str.__eq__
    known = [topic for topic in recording.topics if topic.count and alike(topic.name, pattern)]
    return [topic.name for topic in sorted(known, key=lambda t: (-t.count, t.name))]


def _place(recording: Recording, signal: str, source: Source, topic: str) -> Place | Note | None:
    """Return a signal's place in a topic, or a note on a missing one; None if none is expected."""
    usual = recording.field_layout(topic, signal)
    fields = source.fields or (usual.fields if usual else None)
    if fields is None:
        kind = next(known.type for known in recording.topics if known.name == topic)
        wild = "*" in source.topic
        return None if wild else NoteCode.LAYOUT_UNKNOWN.note(kind, signal, topic=topic)
    unit = source.unit or (usual.unit if usual and not source.fields else "si")
    frame = source.frame or (usual.frame if usual else "enu_flu")
    missing = recording.missing_fields(topic, Place(source, topic, fields, unit, frame).read)
    if missing:
        # a table, or any topic at all, need not hold every signal of a map
        anywhere = is_tabular(recording.format) or source.topic == "*"
        absent = anywhere and set(fields) <= set(missing)
        near = difflib.get_close_matches(missing[0], recording.fields(topic), n=1)
        note = NoteCode.FIELD_MISSING.note(missing[0], signal, *near, topic=topic)
        return None if absent else note
    if source.quaternion == "xyzw" and SIGNALS[signal].axes == "attitude":
        fields = (fields[3], *fields[:3])
    return Place(source, topic, fields, unit, frame)


def unread_columns(
    recording: Recording, topics: TopicMap, places: Mapping[str, Place]
) -> tuple[Note, ...]:
    """Return a note on the columns of a table that the map does not name, if there are any."""
    if not is_tabular(recording.format):
        return ()
    read = {field for place in places.values() for field in place.read}
    read |= {clock.field for clock in topics.time}
    columns = [name for topic in recording.topics for name in recording.fields(topic.name)]
    others = tuple(name for name in columns if name not in read)
    note = NoteCode.COLUMNS_UNREAD.note(*others[:MAX_NAMED], kind="info", count=len(others))
    return (note,) if others else ()


def with_columns_by_name(
    recording: Recording, topics: TopicMap
) -> tuple[TopicMap, tuple[Note, ...]]:
    """Return a table's map with the columns that it lacks, recognised by their names.

    Returns
    -------
    tuple
        The map, and a note for each signal that was added.
    """
    if not is_tabular(recording.format):
        return topics, ()
    columns = recording.fields("")
    time, found = sources_by_name(columns, recording.units)
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
        unwanted = topics.signals.get(signal) == ()
        if signal not in places and not unwanted and not taken & set(fields):
            signals[signal] = (source,)
            notes.append(NoteCode.COLUMNS_TAKEN.note(signal, *fields, kind="info"))
    return whole.replace(signals=signals), tuple(notes)


def _table_problem(
    recording: Recording, topics: TopicMap, what: str, *, by_user: bool
) -> tuple[str, str]:
    """Return why a table holds no pose, and what to do."""
    columns = recording.fields("")
    if recording.naming_problem is not None and not by_user:
        return recording.naming_problem
    listed = f"{', '.join(columns[:MAX_NAMED])}{', ...' if len(columns) > MAX_NAMED else ''}"
    clocks = [clock.field for clock in topics.time]
    if not any(field in columns for field in clocks):
        named = f"the topic map '{topics.name}' finds no time: no column {' or '.join(clocks)}"
        return (
            named if by_user else f"has no column that is a time among {listed}",
            "name it under 'time' in a topic map (--topics FILE)",
        )
    if by_user:
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


def _type_error(recording: Recording, signals: Iterable[str]) -> RecordingError | None:
    """Return the error of a topic with some signals whose type is defined nowhere."""
    for topic in recording.topics:
        holds = topic.count and any(
            recording.field_layout(topic.name, signal) for signal in signals
        )
        if holds and not recording.is_defined(topic.name):
            return RecordingError(
                recording.path,
                f"holds {topic.name}, but not the definition of its type {topic.type}, which "
                "databases of ROS 2 Humble and before do not",
                "name the folder of its package's .msg files under 'messages' in a topic map "
                "(extends: px4_ros2), or convert the recording to MCAP",
            )
    return None


def pose_error(
    recording: Recording, topics: TopicMap, places: Mapping[str, Place], *, by_user: bool = False
) -> RecordingError | None:
    """Return why no pose was found, with similar topic names; None if one was.

    Parameters
    ----------
    by_user
        Whether a user wrote the map.
    """
    missing = [signal for signal in ("position", "attitude") if signal not in places]
    if not missing:
        return None
    what = " and ".join(missing)
    if is_tabular(recording.format):
        return RecordingError(
            recording.path, *_table_problem(recording, topics, what, by_user=by_user)
        )
    sources = [source for signal in missing for source in topics.signals.get(signal, ())]
    if not sources:
        named = f"the topic map '{topics.name}' names no topic for {what}"
        return RecordingError(recording.path, named, "add one")
    return _type_error(recording, missing) or _topic_error(recording, what, sources)


def _topic_error(recording: Recording, what: str, sources: Sequence[Source]) -> RecordingError:
    """Return the error that no topic holds a pose, with similar names."""
    path, names = recording.path, [topic.name for topic in recording.topics if topic.count]
    if all(source.topic == "*" for source in sources):
        held = [field for name in names for field in recording.fields(name)]
        return RecordingError(
            path,
            f"holds no {what}, only {', '.join(held[:12]) or 'nothing'}",
            "log the vehicle's estimate of it, or motion capture; body rate, acceleration and "
            "motor commands are fitted without one, by themselves (tune --flights)",
        )
    wanted = list(dict.fromkeys(source.topic for source in sources))
    for topic in wanted:
        elsewhere = [name for name in names if name.endswith(topic) and name != topic]
        if elsewhere:
            found = f"no topic {topic}; found {' and '.join(elsewhere)}"
            prefixes = (name[: -len(topic)].strip("/") for name in elsewhere)
            return RecordingError(path, found, f"use --namespace {' or '.join(prefixes)}")
    near = [n for topic in wanted for n in difflib.get_close_matches(topic, names, n=2, cutoff=0.6)]
    listed = ", ".join(dict.fromkeys(near)) if near else ", ".join(names[:12]) or "nothing at all"
    return RecordingError(
        path,
        f"no topic {' or '.join(wanted[:4])} for {what}; "
        f"{'similar are' if near else 'it holds'} {listed}",
        "name the right one in a topic map (--topics FILE)",
    )

"""What reading a recording found, changed or lost: codes with numbers, and the texts of each."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any, Literal

from tuner.core.phrases import listed

Kind = Literal["info", "warning"]


class NoteCode(StrEnum):
    """What was found or changed; the comment after each names its numbers and its names."""

    TOPIC_MAP = "topic_map"  # names: the topic map
    OTHERS_MATCH = "others_match"  # names: the signal, the topics that would match as well
    LAYOUT_UNKNOWN = "layout_unknown"  # names: the message type, the signal
    FIELD_MISSING = "field_missing"  # names: the field, the signal, a field that is called alike
    COLUMNS_UNREAD = "columns_unread"  # names: those columns of a table, some of them
    COLUMNS_TAKEN = "columns_taken"  # names: the signal, the columns
    WITHOUT_POSE = "without_pose"  # seconds with turning motors
    OTHER_CLOCK = "other_clock"  # seconds
    STAMPS_UNSET = "stamps_unset"
    NO_HEADER = "no_header"
    STAMPS_REPLACED = "stamps_replaced"
    CLOCK_JUMPED = "clock_jumped"  # seconds, the largest jump
    POSE_ON_TIME = "pose_on_time"  # seconds
    POSE_MOVED = "pose_moved"  # seconds
    CLOCK_DRIFTS = "clock_drifts"  # drift (share)
    ROWS_WITHOUT_TIME = "rows_without_time"
    OUT_OF_RANGE = "out_of_range"  # lower, upper; names: the signal, as of all below
    UNIT_UNKNOWN = "unit_unknown"  # lower, upper, median
    NOT_A_NUMBER = "not_a_number"
    OUT_OF_ORDER = "out_of_order"
    FAR_IN_TIME = "far_in_time"
    STAMPED_TWICE = "stamped_twice"
    SAMPLES_MISSING = "samples_missing"
    NO_UNIT_QUATERNION = "no_unit_quaternion"
    REPEATED = "repeated"
    STALE = "stale"  # seconds
    AWAY_AND_BACK = "away_and_back"
    AWAY_FOR_GOOD = "away_for_good"
    OUTLIERS = "outliers"
    SIGNAL_UNKNOWN = "signal_unknown"  # seconds, longest (s)
    NO_TACHOMETER = "no_tachometer"  # names: the rotors
    FRAME_TURNED = "frame_turned"  # names: the signal, the frame that it is in
    UNIT_READ = "unit_read"  # names: the signal, the unit that it is in
    SPEED_UNIT_OPEN = "speed_unit_open"  # names: the unit of `UNITS` that is assumed
    MOTOR_ORDER_GIVEN = "motor_order_given"  # names: the order of `MOTOR_ORDERS`, or the motors
    PX4_REFERENCE = "px4_reference"
    POSE_ALONE = "pose_alone"
    TIME_READ = "time_read"
    UNIT_DOUBTED = "unit_doubted"  # times; names: the signal
    ATTITUDE_DOUBTED = "attitude_doubted"  # agreement, upright
    BODY_RATE_DOUBTED = "body_rate_doubted"  # left (share)
    VELOCITY_DOUBTED = "velocity_doubted"  # agreement
    CONTRADICTED = "contradicted"  # agreement; names: the signal, the signal that denies it
    COMMAND_DERIVED = "command_derived"
    NOT_CHOSEN = "not_chosen"
    ONE_OF_SEVERAL = "one_of_several"  # number of the mission


@dataclass(frozen=True)
class Note:
    """Something that reading found or changed.

    Attributes
    ----------
    code
        What it is.
    kind
        ``info`` for what was done, ``warning`` for what a user should look at.
    topic
        The topic or signal concerned; empty for the whole recording.
    count
        How many samples, or whatever else the code counts, it concerns.
    numbers, names
        What `NoteCode` lists beside the code.
    """

    code: NoteCode
    kind: Kind = "warning"
    topic: str = ""
    count: int = 0
    numbers: Mapping[str, float] = field(default_factory=dict)
    names: tuple[str, ...] = ()

    @classmethod
    def read(cls, raw: Mapping[str, Any]) -> Note:
        """Return the note of what `dataclasses.asdict` made of one."""
        return cls(**{**raw, "code": NoteCode(raw["code"]), "names": tuple(raw["names"])})


class Cause(StrEnum):
    """How a recording is broken."""

    NOT_CLOSED = "not_closed"
    """The recorder was stopped before it wrote the index."""
    END_MISSING = "end_missing"
    """The file stops in the middle of a record."""
    INDEX_DAMAGED = "index_damaged"
    """The index contradicts the file, which is then read from its beginning."""
    CHUNKS_DAMAGED = "chunks_damaged"
    """Chunks inside the file cannot be unpacked or followed."""
    MESSAGES_DAMAGED = "messages_damaged"
    """Messages of one topic end before their last field."""
    DATABASE_DAMAGED = "database_damaged"
    """Pages of an SQLite database cannot be read."""
    LOG_DAMAGED = "log_damaged"
    """Parts of a PX4 log cannot be followed."""
    LOGGER_DROPOUTS = "logger_dropouts"
    """The vehicle's logger could not keep up."""
    ROWS_MALFORMED = "rows_malformed"
    """Lines of a table have too few or too many cells."""
    FILE_UNREADABLE = "file_unreadable"
    """One of several files of the recording cannot be read."""
    METADATA_MISSING = "metadata_missing"
    """A folder's ``metadata.yaml`` is missing or makes no sense; the data files were listed."""


@dataclass(frozen=True)
class Damage:
    """One way in which a recording is broken, and what that cost; None where it is unknown.

    Attributes
    ----------
    cause
        How it is broken.
    subject
        The topic or file concerned; empty for the whole recording.
    salvaged
        Messages that were read nevertheless.
    lost
        Messages, or rows of a table, that were lost.
    bytes_lost
        Bytes of the file that could not be read.
    occurrences
        How many chunks, pages, drop-outs or files this sums up.
    seconds_lost
        s of which messages are missing altogether.
    start, end
        When the loss began and ended, in s: since the start of the mission in a `Flight`, since
        1970 by the recorder's clock in what a reader returns.
    """

    cause: Cause
    subject: str = ""
    salvaged: int | None = None
    lost: int | None = None
    bytes_lost: int | None = None
    occurrences: int = 1
    seconds_lost: float | None = None
    start: float | None = None
    end: float | None = None

    def later(self, seconds: float) -> Damage:
        """Return the damage with its times moved by some seconds."""
        start = None if self.start is None else self.start + seconds
        end = None if self.end is None else self.end + seconds
        return replace(self, start=start, end=end)

    @classmethod
    def read(cls, raw: Mapping[str, Any]) -> Damage:
        """Return the damage of what `dataclasses.asdict` made of one."""
        return cls(**{**raw, "cause": Cause(raw["cause"])})


#: Code -> text with the note's count and numbers in braces; ``first`` and ``second`` for one of its
#: names, ``others`` for all but the first, ``samples`` for the count with all signals,
#: ``milliseconds`` and ``ppm`` for its seconds and its drift.
TEXTS: Mapping[NoteCode, str] = {
    NoteCode.TOPIC_MAP: "topic map '{first}' finds {count} signals",
    NoteCode.OTHERS_MATCH: "{first} from {topic}; {others} would also match",
    NoteCode.LAYOUT_UNKNOWN: "it is not known where {topic} ({first}) holds the {second}",
    NoteCode.FIELD_MISSING: "{where} '{first}' for the {second}{alike}",
    NoteCode.COLUMNS_UNREAD: (
        "{count} columns are not read, which the topic map does not name: {all}{more}"
    ),
    NoteCode.COLUMNS_TAKEN: "{first} is taken from the columns {others}, by their names",
    NoteCode.WITHOUT_POSE: (
        "no pose was recorded: the {seconds:.1f} s with turning motors are fitted without motion "
        "capture, by body rate and specific force"
    ),
    NoteCode.OTHER_CLOCK: "stamped by another clock, {seconds:.3f} s off: moved",
    NoteCode.STAMPS_UNSET: "its stamps are not set: its times are those of recording",
    NoteCode.NO_HEADER: "has no header: its times are those of recording",
    NoteCode.STAMPS_REPLACED: (
        "{count} stamps far from their neighbours replaced by the time of recording"
    ),
    NoteCode.CLOCK_JUMPED: (
        "its clock jumped {count} times, by up to {seconds:.3f} s: joined again"
    ),
    NoteCode.POSE_ON_TIME: (
        "stamps are {milliseconds:+.1f} ms late against the gyro, by correlation"
    ),
    NoteCode.POSE_MOVED: (
        "its clock is {milliseconds:+.1f} ms late against the gyro, by correlation: moved"
    ),
    NoteCode.CLOCK_DRIFTS: "the publisher's clock drifts by {ppm:+.0f} ppm against its stamps",
    NoteCode.ROWS_WITHOUT_TIME: "{count} rows without a time left out",
    NoteCode.OUT_OF_RANGE: "{samples} outside {lower:g} to {upper:g} dropped",
    NoteCode.UNIT_UNKNOWN: (
        "{samples} dropped: they lie around {median:.4g}, outside {lower:g} to {upper:g}, and no "
        "unit is certain; give {first} its 'unit' in the topic map"
    ),
    NoteCode.NOT_A_NUMBER: "{samples} without a number dropped",
    NoteCode.OUT_OF_ORDER: "{samples} out of order, put in order",
    NoteCode.FAR_IN_TIME: "{samples} stamped hours away from the others dropped",
    NoteCode.STAMPED_TWICE: "{samples} with a stamp seen before dropped",
    NoteCode.SAMPLES_MISSING: "{samples} seem to be missing between those recorded",
    NoteCode.NO_UNIT_QUATERNION: "{samples} that are no unit quaternion dropped or normalised",
    NoteCode.REPEATED: "{samples} repeat the one before while the vehicle moves: dropped",
    NoteCode.STALE: (
        "{samples} repeat the one before to the bit through the last {seconds:.1f} s, while the "
        "vehicle moves on: nothing measured them"
    ),
    NoteCode.AWAY_AND_BACK: "{samples} jump away and back within a second: dropped",
    NoteCode.AWAY_FOR_GOOD: "{samples} leap and do not come back: check the recording",
    NoteCode.OUTLIERS: "{samples} far from their neighbours dropped as outliers",
    NoteCode.SIGNAL_UNKNOWN: "{first} is unknown for {seconds:.2f} s, {longest:.2f} s at a time",
    NoteCode.NO_TACHOMETER: "rotors {all} have no tachometer",
    NoteCode.FRAME_TURNED: "{first} is {second}, which the topic map does not say: turned",
    NoteCode.UNIT_READ: "{first} is {second}, which the topic map does not say: read so",
    NoteCode.SPEED_UNIT_OPEN: (
        "the topic map gives rotor_speed no unit: {first} is taken, and held against the weight "
        "that the rotors carry"
    ),
    NoteCode.MOTOR_ORDER_GIVEN: "its motors are read in the order {first}",
    NoteCode.PX4_REFERENCE: (
        "is what PX4's own position control was asked for, another loop than the geometric one"
    ),
    NoteCode.POSE_ALONE: (
        "a pose alone was recorded, and nothing that drives the vehicle: no motor commands, rotor "
        "speeds, set-points or reference"
    ),
    NoteCode.TIME_READ: (
        "times are a thousandth of what their step seemed to say, by gravity: read so"
    ),
    NoteCode.UNIT_DOUBTED: (
        "{first} accelerates {times:.3g} times as fast as the attitude's tilt says under gravity: "
        "check its unit"
    ),
    NoteCode.ATTITUDE_DOUBTED: (
        "the attitude does not tilt as the vehicle accelerates (agreement {agreement:.2f}, "
        "upright {upright:.2f}): check its frame and order"
    ),
    NoteCode.BODY_RATE_DOUBTED: (
        "the body rate is not the attitude's change ({left:.1f} of it is left)"
    ),
    NoteCode.VELOCITY_DOUBTED: (
        "the velocity is not the position's change (agreement {agreement:.2f})"
    ),
    NoteCode.CONTRADICTED: (
        "{first} and {second} contradict each other (agreement {agreement:.2f} of 1), so that no "
        "fit can use the recording: is it reversed in time, or one of them in another frame?"
    ),
    NoteCode.COMMAND_DERIVED: (
        "its motor commands are those that, by the vehicle file's arms and curve, give the "
        "commanded thrust and torque: what was found of thrust and inertia is relative to that"
    ),
    NoteCode.NOT_CHOSEN: (
        "it is not fitted: other manoeuvres of this long recording show more, or its side-car "
        "names others"
    ),
    NoteCode.ONE_OF_SEVERAL: "mission {number:.0f} of {count} in this recording",
}
PASSED_OVER = (NoteCode.LAYOUT_UNKNOWN, NoteCode.FIELD_MISSING)


def reason_in_words(note: Note) -> str:
    """Return what was found or changed."""
    first, second, alike, *_ = (*note.names, "", "", "")
    return TEXTS[note.code].format(
        **note.numbers,
        count=note.count,
        topic=note.topic,
        first=first,
        second=second,
        all=", ".join(note.names),
        more=", ..." if note.count > len(note.names) else "",
        others=", ".join(note.names[1:]),
        samples=f"{note.count} {listed(note.names or ('',))} samples",
        where=f"{note.topic} has no field" if note.topic else "there is no column",
        alike=f", did you mean '{alike}'?" if alike else "",
        milliseconds=1e3 * note.numbers.get("seconds", 0.0),
        ppm=1e6 * note.numbers.get("drift", 0.0),
    )


def note_in_words(note: Note) -> str:
    """Return the same, and that a source was passed over for it where it was."""
    reason = reason_in_words(note)
    return f"passed over: {reason}" if note.code in PASSED_OVER else reason


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


def _dropouts(damage: Damage) -> str:
    lost = f" ({damage.seconds_lost:.2f} s in all)" if damage.seconds_lost else ""
    return f"the vehicle's logger dropped messages {_count(damage.occurrences, 'time')}{lost}"


_HOW: Mapping[Cause, Callable[[Damage], str]] = {
    Cause.NOT_CLOSED: lambda _: "the recording was not closed and has no index",
    Cause.END_MISSING: lambda _: "the end of the file is missing",
    Cause.INDEX_DAMAGED: lambda _: "the index of the file is damaged",
    Cause.CHUNKS_DAMAGED: lambda d: f"{_count(d.occurrences, 'chunk')} of the file cannot be read",
    Cause.MESSAGES_DAMAGED: lambda d: f"messages of {d.subject} are cut or damaged",
    Cause.DATABASE_DAMAGED: lambda _: "pages of the database are damaged",
    Cause.LOG_DAMAGED: lambda _: "parts of the log are damaged",
    Cause.LOGGER_DROPOUTS: _dropouts,
    Cause.ROWS_MALFORMED: lambda _: "lines of the table have too few or too many cells",
    Cause.FILE_UNREADABLE: lambda d: f"{d.subject} cannot be read",
    Cause.METADATA_MISSING: lambda d: (
        f"{d.subject} is missing or damaged, so all data files in the folder are read"
    ),
}


def damage_sentence(damage: Damage) -> str:
    """Return how a recording is broken, what was lost, what was salvaged and when.

    Times count from the start of the mission, or as those of the damage do.
    """
    parts = [_HOW[damage.cause](damage)]
    lost = [] if damage.lost is None else [_count(damage.lost, _noun(damage.cause))]
    lost += [_count(damage.bytes_lost, "byte")] if damage.bytes_lost else []
    if lost:
        parts.append(f"{' in '.join(lost)} lost")
    if damage.salvaged is not None:
        parts.append(f"{_count(damage.salvaged, 'message')} salvaged")
    if damage.start is not None:
        until = "" if damage.end is None else f" to t = {damage.end:.2f} s"
        parts.append(f"from t = {damage.start:.2f} s{until}")
    return "; ".join(parts)


def _noun(cause: Cause) -> str:
    return "row" if cause is Cause.ROWS_MALFORMED else "message"

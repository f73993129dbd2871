"""Notes and damage of a recording: codes with numbers, and their texts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

from tuner.core.phrases import CodeWithText, listed

Kind = Literal["info", "warning"]


class NoteCode(CodeWithText):
    """Codes of notes; a comment lists the names of each.

    A text has the note's count and numbers in braces; ``first`` and ``second`` for one of its
    names, ``others`` for all but the first, ``samples`` for the count with all signals,
    ``milliseconds`` and ``ppm`` for its seconds and its drift.
    """

    TOPIC_MAP = "topic_map", "topic map '{first}' finds {count} signals"  # names: the topic map
    OTHERS_MATCH = (
        "others_match",  # names: the signal, the topics that would match as well
        "{first} from {topic}; {others} would also match",
    )
    LAYOUT_UNKNOWN = (
        "layout_unknown",  # names: the message type, the signal
        "it is not known where {topic} ({first}) holds the {second}",
    )
    FIELD_MISSING = (
        "field_missing",  # names: the field, the signal, a field that is called alike
        "{where} '{first}' for the {second}{alike}",
    )
    COLUMNS_UNREAD = (
        "columns_unread",  # names: those columns of a table, some of them
        "{count} columns are not read, which the topic map does not name: {all}{more}",
    )
    COLUMNS_TAKEN = (
        "columns_taken",  # names: the signal, the columns
        "{first} is taken from the columns {others}, by their names",
    )
    WITHOUT_POSE = (
        "without_pose",
        "no pose: {seconds:.1f} s of flight are fitted by body rate and specific force",
    )
    OTHER_CLOCK = "other_clock", "stamped by another clock, {seconds:.3f} s off: moved"
    STAMPS_UNSET = (
        "stamps_unset",
        "its stamps are not set, or too coarse: its times are those of recording",
    )
    NO_HEADER = "no_header", "has no header: its times are those of recording"
    STAMPS_REPLACED = (
        "stamps_replaced",
        "{count} stamps far from their neighbours replaced by the time of recording",
    )
    CLOCK_JUMPED = (
        "clock_jumped",
        "its clock jumped {count} times, by up to {seconds:.3f} s: joined again",
    )
    POSE_ON_TIME = (
        "pose_on_time",
        "stamps are {milliseconds:+.1f} ms late against the gyro, by correlation",
    )
    POSE_MOVED = (
        "pose_moved",
        "the pose is stamped {milliseconds:+.1f} ms late against the gyro, by correlation: moved",
    )
    CLOCK_DRIFTS = (
        "clock_drifts",
        "the publisher's clock drifts by {ppm:+.0f} ppm against its stamps",
    )
    ROWS_WITHOUT_TIME = "rows_without_time", "{count} rows without a time left out"
    OUT_OF_RANGE = (
        "out_of_range",  # names: the signal, as of all below
        "{samples} outside {lower:g} to {upper:g} dropped",
    )
    UNIT_UNKNOWN = (
        "unit_unknown",
        (
            "{samples} dropped: they lie around {median:.4g}, outside {lower:g} to {upper:g}, and "
            "no unit is certain; give {first} its 'unit' in the topic map"
        ),
    )
    NOT_A_NUMBER = "not_a_number", "{samples} without a number dropped"
    OUT_OF_ORDER = "out_of_order", "{samples} out of order, put in order"
    FAR_IN_TIME = "far_in_time", "{samples} stamped hours away from the others dropped"
    STAMPED_TWICE = "stamped_twice", "{samples} with a stamp seen before dropped"
    STAMPS_COARSE = (
        "stamps_coarse",
        "{samples} share a stamp and are dropped: steps of {milliseconds:.3g} ms are too coarse",
    )
    SAMPLES_MISSING = "samples_missing", "{samples} seem to be missing between those recorded"
    NO_UNIT_QUATERNION = (
        "no_unit_quaternion",
        "{samples} that are no unit quaternion dropped or normalised",
    )
    REPEATED = "repeated", "{samples} repeat the one before while the vehicle moves: dropped"
    HELD = (
        "held",
        "{samples} repeat the one before, as joined tables do: dropped, its rate is {rate:.3g} Hz",
    )
    STALE = (
        "stale",
        "{samples} repeat one value in the last {seconds:.1f} s, while the vehicle moves",
    )
    AWAY_AND_BACK = "away_and_back", "{samples} jump away and back within a second: dropped"
    AWAY_FOR_GOOD = "away_for_good", "{samples} leap and do not come back: check the recording"
    OUTLIERS = "outliers", "{samples} far from their neighbours dropped as outliers"
    SIGNAL_UNKNOWN = (
        "signal_unknown",
        "{first} is unknown for {seconds:.2f} s, {longest:.2f} s at a time",
    )
    COMMAND_DEAD = (
        "command_dead",  # names: the rotors, from 1
        "the commands of rotors {all} never change while the others do: not read",
    )
    NO_TACHOMETER = "no_tachometer", "rotors {all} have no tachometer"  # names: from 1
    FRAME_TURNED = (
        "frame_turned",  # names: the signal, the frame that it is in
        "{first} is {second}, which the topic map does not say: turned",
    )
    UNIT_READ = (
        "unit_read",  # names: the signal, the unit that it is in
        "{first} is {second}, which the topic map does not say: read so",
    )
    SPEED_UNIT_OPEN = (
        "speed_unit_open",  # names: the unit of `UNITS` that is assumed
        "the topic map gives rotor_speed no unit: {first} is assumed, and checked by the weight",
    )
    MOTOR_ORDER_GIVEN = (
        "motor_order_given",  # names: the order of `MOTOR_ORDERS`, or the motors
        "its motors are read in the order {first}",
    )
    PX4_REFERENCE = (
        "px4_reference",
        "is the reference of PX4's position control, not of the geometric controller",
    )
    POSE_ALONE = (
        "pose_alone",
        "no motor command, rotor speed, set-point or reference was recorded beside the pose",
    )
    TIME_READ = (
        "time_read",
        "times are a thousandth of what their step seemed to say, by gravity: read so",
    )
    UNIT_DOUBTED = (
        "unit_doubted",  # names: the signal
        "{first} accelerates {times:.3g} times as fast as tilt and gravity say: check its unit",
    )
    ATTITUDE_DOUBTED = (
        "attitude_doubted",
        (
            "the attitude does not tilt as the vehicle accelerates (agreement {agreement:.2f}, "
            "upright {upright:.2f}): check its frame and order"
        ),
    )
    WEIGHT_NOT_FELT = (
        "weight_not_felt",
        (
            "the accelerometer feels {share:.2f} of the weight, though the attitude fits the "
            "motion: is gravity taken away from it, or are its axes other?"
        ),
    )
    BODY_RATE_DOUBTED = (
        "body_rate_doubted",
        "the body rate is not the attitude's change ({left:.1f} of it is left)",
    )
    VELOCITY_DOUBTED = (
        "velocity_doubted",
        "the velocity is not the position's change (agreement {agreement:.2f})",
    )
    AXIS_DOUBTED = (
        "axis_doubted",  # names: the signal, its axis, whose change it is
        "{first} along {second} is {times:.2f} times the change of {third}: check axes, unit, time",
    )
    SIGNAL_LATE = (
        "signal_late",  # names: the signal, the one whose change it is
        "{second} is {milliseconds:+.0f} ms late against {first}, by correlation: check its stamps",
    )
    CLOCK_DOUBTED = (
        "clock_doubted",  # names: the two signals
        "the times run {times:.2f} times as long as {first} and {second} say: check their unit",
    )
    GYRO_SATURATED = (
        "gyro_saturated",
        (
            "{count} samples stay at plus or minus {limit:.3g} rad/s, where the gyro saturates: "
            "turn slower, or set it to a wider range"
        ),
    )
    AXES_TURNED = (
        "axes_turned",
        "the attitude's body axes are turned by {degrees:.0f}° against the gyro's: check markers",
    )
    CONTRADICTED = (
        "contradicted",  # names: the signal, the signal that denies it
        (
            "{first} and {second} contradict each other (agreement {agreement:.2f} of 1), so that "
            "no fit can use the recording: is it reversed in time, or one of them in another "
            "frame?"
        ),
    )
    COMMAND_DERIVED = (
        "command_derived",
        (
            "its motor commands are those that, by the vehicle file's arms and curve, give the "
            "commanded thrust and torque: what was found of thrust and inertia is relative to "
            "that"
        ),
    )
    NOT_CHOSEN = (
        "not_chosen",
        "not fitted: other manoeuvres of the recording move more, or its side-car names others",
    )
    ONE_OF_SEVERAL = "one_of_several", "mission {number:.0f} of {count} in this recording"

    def note(
        self,
        *names: str,
        kind: Kind = "warning",
        topic: str = "",
        count: int = 0,
        **numbers: float,
    ) -> Note:
        """Return a note of this code, with its names and numbers."""
        return Note(self, kind, topic, count, numbers, names)


@dataclass(frozen=True)
class Note:
    """A remark on a recording, or a repair.

    Attributes
    ----------
    kind
        ``info`` for a repair, ``warning`` for something that the user should check.
    topic
        The topic or signal concerned; empty for the whole recording.
    count
        The number of samples, or of other things that the code counts.
    numbers, names
        As `NoteCode` lists them beside the code.
    """

    code: NoteCode
    kind: Kind = "warning"
    topic: str = ""
    count: int = 0
    numbers: Mapping[str, float] = field(default_factory=dict)
    names: tuple[str, ...] = ()


class Cause(CodeWithText):
    """Causes of damage.

    A text has the damage's ``subject`` in braces, its occurrences as ``chunks`` or ``times``, and
    ``lost`` for the time without messages.
    """

    NOT_CLOSED = "not_closed", "the recording was not closed and has no index"
    END_MISSING = "end_missing", "the end of the file is missing"
    INDEX_DAMAGED = "index_damaged", "the index of the file is damaged"
    CHUNKS_DAMAGED = "chunks_damaged", "{chunks} of the file cannot be read"
    MESSAGES_DAMAGED = "messages_damaged", "messages of {subject} are cut or damaged"
    DATABASE_DAMAGED = "database_damaged", "pages of the database are damaged"
    LOG_DAMAGED = "log_damaged", "parts of the log are damaged"
    LOGGER_DROPOUTS = "logger_dropouts", "the vehicle's logger dropped messages {times}{lost}"
    ROWS_MALFORMED = "rows_malformed", "lines of the table have too few or too many cells"
    FILE_UNREADABLE = "file_unreadable", "{subject} cannot be read"
    METADATA_MISSING = (
        "metadata_missing",
        "{subject} is missing or damaged, so all data files in the folder are read",
    )


@dataclass(frozen=True)
class Damage:
    """Damage of a recording, and its extent; None where it is unknown.

    Attributes
    ----------
    subject
        The topic or file concerned; empty for the whole recording.
    salvaged
        Messages that were still read.
    lost
        Messages, or rows of a table, that were lost.
    bytes_lost
        Bytes of the file that could not be read.
    occurrences
        The number of chunks, pages, drop-outs or files.
    seconds_lost
        s without any message.
    start, end
        Begin and end of the loss, in s: since the start of the mission in a `Flight`, since 1970
        by the recorder's clock in a `ReadResult`.
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


REJECTED_SOURCE_CODES = (NoteCode.LAYOUT_UNKNOWN, NoteCode.FIELD_MISSING)


def note_text(note: Note) -> str:
    """Return the text of a note."""
    first, second, alike, *_ = (*note.names, "", "", "")
    return str(note.code.text).format(
        **note.numbers,
        count=note.count,
        topic=note.topic,
        first=first,
        second=second,
        third=alike,
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
    """Return the text of a note, which says if a source was passed over."""
    reason = note_text(note)
    return f"passed over: {reason}" if note.code in REJECTED_SOURCE_CODES else reason


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


def damage_sentence(damage: Damage) -> str:
    """Return a sentence on cause, loss, salvage and times of a damage."""
    how = damage.cause.text.format(
        subject=damage.subject,
        chunks=_count(damage.occurrences, "chunk"),
        times=_count(damage.occurrences, "time"),
        lost=f" ({damage.seconds_lost:.2f} s in all)" if damage.seconds_lost else "",
    )
    parts = [how]
    noun = "row" if damage.cause is Cause.ROWS_MALFORMED else "message"
    lost = [] if damage.lost is None else [_count(damage.lost, noun)]
    lost += [_count(damage.bytes_lost, "byte")] if damage.bytes_lost else []
    if lost:
        parts.append(f"{' in '.join(lost)} lost")
    if damage.salvaged is not None:
        parts.append(f"{_count(damage.salvaged, 'message')} salvaged")
    if damage.start is not None:
        until = "" if damage.end is None else f" to t = {damage.end:.2f} s"
        parts.append(f"from t = {damage.start:.2f} s{until}")
    return "; ".join(parts)

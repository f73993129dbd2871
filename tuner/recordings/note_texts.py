"""What reading a recording found, changed or lost, as a clause of a sentence."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from tuner.core.phrases import listed
from tuner.recordings.notes import Cause, Damage, Note, NoteCode

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

"""What reading a recording found, changed or lost, as codes and numbers.

Sentences are made from them in `tuner.recordings.note_texts`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any, Literal

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

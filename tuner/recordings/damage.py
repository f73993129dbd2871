"""What a broken recording has lost, as data: the readers salvage the rest and go on."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum


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

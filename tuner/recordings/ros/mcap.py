"""The MCAP container of ROS 2.

rosbags and the mcap package's indexed reader raise on a file without its end; here 14,697 messages
of the shipped circle flight cut in half are salvaged. The mcap package's stream reader finds as
many, but spent over 25 s on a 1.6 MB file whose chunk claims 1 GiB, which is refused here in 0.3 s.
Iterating over a 49 MB file takes the mcap package 2.6 s; its fields take 0.28 s here.
"""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from rosbags.interfaces import MessageDefinition
from rosbags.typesys.msg import normalize_msgtype

from tuner.core.errors import RecordingError
from tuner.recordings.notes import Cause
from tuner.recordings.ros.container import (
    DEFINITION_FORMATS,
    MAX_CHUNK_BYTES,
    NO_DEFINITION,
    Chunk,
    ChunkedFile,
    ChunkIndex,
    Connection,
    Content,
    FileBytes,
    Record,
    RecordContent,
    unsigned,
)
from tuner.recordings.ros.messages import Bytes, Index, MessageBlock

MAGIC = b"\x89MCAP0\r\n"
SCHEMA, CHANNEL, MESSAGE, CHUNK, INDEX = 0x03, 0x04, 0x05, 0x06, 0x07

#: Bytes of a message record before its payload: op, length, channel, sequence, two times.
MESSAGE_HEAD_BYTES = 9 + 22
#: Channel, sequence and time of a message. The time is read with a sign, as in the indexes: a
#: damaged one beyond 2^63 then fits into an array, centuries before the others.
_HEAD = struct.Struct("<HIq")


@dataclass
class Mcap(ChunkedFile):
    """An MCAP file with ROS messages.

    Its summary repeats schemas and channels.
    """

    ENTRY_BYTES = 16
    _schemas: dict[int, tuple[str, MessageDefinition]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        with self.path.open("rb") as stream:
            data = FileBytes(stream)
            if data[0 : len(MAGIC)] != MAGIC:
                raise RecordingError(self.path, "is no MCAP file", "give the recording itself")
            closed = data[len(data) - len(MAGIC) : len(data)] == MAGIC
            last = len(data) - closed * len(MAGIC)
            self._read(data, len(MAGIC), last, None if closed else Cause.END_MISSING)
        if not self.connections:
            raise RecordingError(self.path, "holds no ROS messages", "record it again")

    def _records(self, data: Content, at: int) -> Iterator[Record]:
        for op, begin, end in records(data, at):
            found: RecordContent = None
            whole = end <= len(data)
            if op == 0:
                return
            if op == CHUNK:
                found = _chunk(data, begin, min(end, len(data)))
            elif op == INDEX and whole:  # a channel, and the length of the entries
                found = ChunkIndex(
                    int.from_bytes(data[begin : begin + 2], "little"), begin + 6, end
                )
            elif op == MESSAGE and whole and end - begin >= _HEAD.size + 8:
                number, _, time = _HEAD.unpack(data[begin : begin + _HEAD.size])
                found = number, time
            elif op in (SCHEMA, CHANNEL) and whole and end - begin < MAX_CHUNK_BYTES:
                with contextlib.suppress(struct.error, ValueError):  # of a damaged one
                    self._read_definitions(op, data[begin:end])
            yield begin - 9, end, found

    def _read_definitions(self, op: int, content: bytes) -> None:
        """Read a schema or a channel."""
        if op == SCHEMA:
            (number,) = struct.unpack_from("<H", content)
            name, at = _string(content, 2)
            encoding, at = _string(content, at)
            text, _ = _string(content, at)
            form = DEFINITION_FORMATS.get(encoding, NO_DEFINITION.format)
            kind = normalize_msgtype(name) if "/" in name else name
            self._schemas[number] = (kind, MessageDefinition(form, text))
        elif op == CHANNEL:
            number, schema = struct.unpack_from("<HH", content)
            topic, at = _string(content, 4)
            encoding, _ = _string(content, at)
            kind, definition = self._schemas.get(schema, ("", NO_DEFINITION))
            if encoding in ("cdr", "ros1") and kind:
                self.aligned = encoding == "cdr"
                self.connections[number] = Connection(number, topic, kind, definition, 0)

    def _entries(self, content: bytes) -> tuple[Index, Index]:
        entries = np.frombuffer(content, dtype="<i8").reshape(-1, 2)
        return entries[:, 0].copy(), entries[:, 1].copy()

    def _block(self, content: Bytes, number: int, time: Index, offset: Index) -> MessageBlock:
        inside = (offset >= 0) & (offset + MESSAGE_HEAD_BYTES <= len(content))
        offset, time = offset[inside], time[inside]
        end = offset + 9 + unsigned(content, offset + 1, 8)
        inside = (content[offset] == MESSAGE) & (unsigned(content, offset + 9, 2) == number)
        inside &= (end >= offset + MESSAGE_HEAD_BYTES) & (end <= len(content))
        return MessageBlock(content, offset[inside] + MESSAGE_HEAD_BYTES, end[inside], time[inside])


def records(data: Content, at: int) -> Iterator[tuple[int, int, int]]:
    """Yield op, start and end of the content of each record; the last may be cut."""
    while at + 9 <= len(data):
        op, length = struct.unpack("<BQ", data[at : at + 9])
        yield op, at + 9, at + 9 + length
        at += 9 + length


def _string(content: bytes, at: int) -> tuple[str, int]:
    (length,) = struct.unpack_from("<I", content, at)
    if at + 4 + length > len(content):
        raise ValueError("a string is cut")
    return content[at + 4 : at + 4 + length].decode(errors="replace"), at + 4 + length


def _chunk(data: Content, begin: int, end: int) -> Chunk:
    """Return a chunk from the head of its record, whose end may be missing."""
    head = data[begin : begin + 40 + 16]
    try:
        (size,) = struct.unpack_from("<Q", head, 16)
        compression, at = _string(head, 28)
        (length,) = struct.unpack_from("<Q", head, at)
    except (struct.error, ValueError):
        return Chunk(begin, end - begin)
    first = begin + at + 8
    return Chunk(first, min(length, max(0, end - first)), compression=compression, size=size)

"""The MCAP container of ROS 2: read by its summary, or from the front without one.

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
from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat
from rosbags.typesys.msg import normalize_msgtype

from tuner.core.errors import RecordingError
from tuner.recordings.notes import Cause
from tuner.recordings.ros.container import (
    MAX_CHUNK_BYTES,
    Chunk,
    ChunkedFile,
    Connection,
    Content,
    DamagedError,
    Entries,
    FileBytes,
    Record,
    RecordContent,
    unsigned,
)
from tuner.recordings.ros.messages import Block, Bytes, Index

MAGIC = b"\x89MCAP0\r\n"
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, INDEX, CHUNK_INDEX, STATISTICS, DATA_END = (
    0x02, 0x03, 0x04, 0x05, 0x06, 0x07, 0x08, 0x0B, 0x0F,
)  # fmt: skip

#: Bytes of a message record before its payload: op, length, channel, sequence, two times.
MESSAGE_HEAD_BYTES = 9 + 22
#: Channel, sequence and time of a message. The time is read with a sign, as in the indexes: a
#: damaged one beyond 2^63 then fits into an array, centuries before the others.
_HEAD = struct.Struct("<HIq")
_FORMATS = {
    "ros2msg": MessageDefinitionFormat.MSG,
    "ros1msg": MessageDefinitionFormat.MSG,
    "ros2idl": MessageDefinitionFormat.IDL,
    "omgidl": MessageDefinitionFormat.IDL,
}


@dataclass
class Mcap(ChunkedFile):
    """An MCAP file with ROS messages.

    The ``held`` of its chunks is the position of the index of a channel's messages.
    """

    _schemas: dict[int, tuple[str, MessageDefinition]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        with self.path.open("rb") as stream:
            data = FileBytes(stream)
            if data[0 : len(MAGIC)] != MAGIC:
                raise RecordingError(self.path, "is no MCAP file", "give the recording itself")
            try:
                self._read_summary(data)
            except DamagedError as err:
                self._walk(data, len(MAGIC), err.cause)
        if not self.connections:
            raise RecordingError(self.path, "holds no ROS messages", "record it again")

    def _read_summary(self, data: FileBytes) -> None:
        """Read channels and chunks from the end of the file."""
        end = max(0, len(data) - 37)
        footer = data[end : len(data)]
        if len(footer) != 37 or footer[-8:] != MAGIC or footer[:9] != b"\x02\x14" + bytes(7):
            raise DamagedError("its end is missing", Cause.END_MISSING)
        (start,) = struct.unpack_from("<Q", footer, 9)
        if not 0 < start <= end:
            raise DamagedError("it has no summary", Cause.NOT_CLOSED)
        if end - start > MAX_CHUNK_BYTES:
            raise DamagedError("its summary is absurdly long")
        counts: dict[int, int] = {}
        summary = data[start:end]
        for op, begin, behind in records(summary, 0):
            content = summary[begin:behind]
            if op == CHUNK_INDEX:
                self._chunks.append(_chunk_index(content, len(data)))
            elif op == STATISTICS:
                counts = _counts(content)
            else:
                self._read_definitions(op, content)
        if not self._chunks or not self.connections:
            raise DamagedError("its summary names no chunks")
        self._set_counts(counts)

    def _records(self, data: Content, at: int) -> Iterator[Record]:
        for op, begin, end in records(data, at):
            found: RecordContent = None
            whole = end <= len(data)
            if op in (0, FOOTER, DATA_END):
                return
            if op == CHUNK:
                found = _chunk(data, begin, min(end, len(data)))
            elif op == MESSAGE and whole and end - begin >= _HEAD.size + 8:
                number, _, time = _HEAD.unpack(data[begin : begin + _HEAD.size])
                found = number, time
            elif op in (SCHEMA, CHANNEL) and whole and end - begin < MAX_CHUNK_BYTES:
                with contextlib.suppress(DamagedError):
                    self._read_definitions(op, data[begin:end])
            yield begin - 9, end, found

    def _read_definitions(self, op: int, content: bytes) -> None:
        """Read a schema or a channel."""
        try:
            if op == SCHEMA:
                (number,) = struct.unpack_from("<H", content)
                name, at = _string(content, 2)
                encoding, at = _string(content, at)
                text, _ = _string(content, at)
                form = _FORMATS.get(encoding, MessageDefinitionFormat.NONE)
                kind = normalize_msgtype(name) if "/" in name else name
                self._schemas[number] = (kind, MessageDefinition(form, text))
            elif op == CHANNEL:
                number, schema = struct.unpack_from("<HH", content)
                topic, at = _string(content, 4)
                encoding, _ = _string(content, at)
                kind, definition = self._schemas.get(
                    schema, ("", MessageDefinition(MessageDefinitionFormat.NONE, ""))
                )
                if encoding in ("cdr", "ros1") and kind:
                    self.aligned = encoding == "cdr"
                    self.connections[number] = Connection(number, topic, kind, definition, 0)
        except (struct.error, ValueError):
            raise DamagedError("a channel makes no sense") from None

    def _index(self, data: FileBytes, chunk: Chunk) -> Entries:
        return {number: _entries(data, at, number) for number, at in chunk.held.items()}

    def _block(self, content: Bytes, number: int, time: Index, offset: Index) -> Block:
        inside = (offset >= 0) & (offset + MESSAGE_HEAD_BYTES <= len(content))
        offset, time = offset[inside], time[inside]
        end = offset + 9 + unsigned(content, offset + 1, 8)
        inside = (content[offset] == MESSAGE) & (unsigned(content, offset + 9, 2) == number)
        inside &= (end >= offset + MESSAGE_HEAD_BYTES) & (end <= len(content))
        return Block(content, offset[inside] + MESSAGE_HEAD_BYTES, end[inside], time[inside])


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


def _chunk_index(content: bytes, size: int) -> Chunk:
    """Return a chunk from its entry in the summary of a file of `size` bytes."""
    try:
        start, end, position, length, indexes = struct.unpack_from("<QQQQI", content)
        held = dict(struct.iter_unpack("<HQ", content[36 : 36 + indexes]))
        compression, at = _string(content, 36 + indexes + 8)
        packed, unpacked = struct.unpack_from("<QQ", content, at)
    except (struct.error, ValueError):
        raise DamagedError("its summary makes no sense") from None
    behind = position + length
    if behind > size or packed > length or any(at >= size for at in held.values()):
        raise DamagedError("its summary points nowhere")
    return Chunk(behind - packed, packed, held, start * 1e-9, end * 1e-9, compression, unpacked)


def _counts(content: bytes) -> dict[int, int]:
    if len(content) < 46 or (len(content) - 46) % 10:
        raise DamagedError("its statistics make no sense")
    return dict(struct.iter_unpack("<HQ", content[46:]))


def _entries(data: FileBytes, at: int, number: int) -> tuple[Index, Index]:
    """Read the times and offsets of one channel's messages in a chunk."""
    head = data[at : at + 15]
    if len(head) != 15:
        raise DamagedError("an index is missing")
    op, _, channel, length = struct.unpack("<BQHI", head)
    if op != INDEX or channel != number or length > MAX_CHUNK_BYTES // 8 or length % 16:
        raise DamagedError("an index makes no sense")
    content = data[at + 15 : at + 15 + length]
    if len(content) != length:
        raise DamagedError("an index is cut")
    entries = np.frombuffer(content, dtype="<i8").reshape(-1, 2)
    return entries[:, 0].copy(), entries[:, 1].copy()

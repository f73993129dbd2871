"""The MCAP container of ROS 2: read by its summary, or walked from the front where that is lost.

rosbags raises on a file without its end ("File end magic is invalid"), and so does the mcap
package's indexed reader; of the shipped circle flight cut in half 14,697 messages are salvaged
here. The mcap package's stream reader finds as many, but spent over 25 s on a 1.6 MB file whose
chunk claims 1 GiB, which is refused here in 0.3 s. Iterating over a 49 MB file takes the mcap
package 2.6 s; its fields are read here in 0.28 s.
"""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from typing import BinaryIO

import numpy as np
from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat
from rosbags.typesys.msg import normalize_msgtype

from tuner.core.errors import RecordingError
from tuner.recordings.notes import Cause
from tuner.recordings.ros.container import (
    LARGEST_CHUNK,
    Chunk,
    ChunkedFile,
    Connection,
    DamagedError,
    Entries,
    read_pieces,
    unsigned,
)
from tuner.recordings.ros.messages import Block, Bytes, Index

MAGIC = b"\x89MCAP0\r\n"
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, INDEX, CHUNK_INDEX, STATISTICS, DATA_END = (
    0x02, 0x03, 0x04, 0x05, 0x06, 0x07, 0x08, 0x0B, 0x0F,
)  # fmt: skip

#: Bytes of a message record before its payload: op, length, channel, sequence, two times.
BEFORE_PAYLOAD = 9 + 22
#: Channel, sequence and time of a message. No true time is beyond 2^63: read with a sign, as in the
#: indexes, a damaged one lies centuries before the others, and fits into an array.
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

    Its chunks' positions are those of their records, and ``held`` says where the index of a
    channel's messages lies.
    """

    _loose: dict[int, list[tuple[int, int, int]]] = field(default_factory=dict)
    _schemas: dict[int, tuple[str, MessageDefinition]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        with self.path.open("rb") as stream:
            if stream.read(len(MAGIC)) != MAGIC:
                raise RecordingError(self.path, "is no MCAP file", "give the recording itself")
            try:
                self._read_summary(stream)
            except DamagedError as err:
                self._walk(stream, err.cause)
        if not self.connections:
            raise RecordingError(self.path, "holds no ROS messages", "record it again")

    def blocks(self, wanted: Collection[int]) -> Iterator[tuple[int, Block]]:
        """Yield the messages of some connections, chunk by chunk, then those outside of chunks."""
        yield from super().blocks(wanted)
        size = self.path.stat().st_size
        with self.path.open("rb") as stream:
            for number in wanted:
                loose = np.array(self._loose.get(number, []), dtype=np.int64).reshape(-1, 3)
                for rows in np.array_split(loose, -(-len(loose) // 4096)) if len(loose) else ():
                    time, starts, ends = rows.T
                    bounds = np.unique([*starts, *ends])
                    content, moved = read_pieces(stream, 0, size, starts, bounds)
                    yield number, self._block(content, number, time, moved)

    def _read_summary(self, stream: BinaryIO) -> None:
        """Learn channels and chunks from the end of the file."""
        size = self.path.stat().st_size
        stream.seek(max(0, size - 37))
        footer = stream.read(37)
        if len(footer) != 37 or footer[-8:] != MAGIC or footer[:9] != b"\x02\x14" + bytes(7):
            raise DamagedError("its end is missing", Cause.END_MISSING)
        (start,) = struct.unpack_from("<Q", footer, 9)
        if not 0 < start <= size - 37:
            raise DamagedError("it has no summary", Cause.NOT_CLOSED)
        if size - start > LARGEST_CHUNK:
            raise DamagedError("its summary is absurdly long")
        stream.seek(start)
        counts: dict[int, int] = {}
        summary = stream.read(size - 37 - start)
        for op, at, end in _records(summary):
            content = summary[at:end]
            if op == CHUNK_INDEX:
                self._chunks.append(_chunk_index(content, size))
            elif op == STATISTICS:
                counts = _counts(content)
            else:
                self._learn(op, content)
        if not self._chunks or not self.connections:
            raise DamagedError("its summary names no chunks")
        self._count(counts)

    def _walk(self, stream: BinaryIO, cause: Cause) -> None:
        """Learn channels and messages from front to end, as far as records can be followed."""
        self._chunks, self.connections = [], {}
        size = self.path.stat().st_size
        at, unread = len(MAGIC), 0
        while at + 9 <= size:
            stream.seek(at)
            op, length = struct.unpack("<BQ", stream.read(9))
            end = at + 9 + length
            if op in (FOOTER, DATA_END) or op == 0 or (end > size and op != CHUNK):
                break
            if op == CHUNK:
                unread += self._add(stream, Chunk(at, min(length, size - at - 9), {}))
            elif op == MESSAGE and length >= 22:
                number, _, time = _HEAD.unpack(stream.read(14))
                self._loose.setdefault(number, []).append((time, at, end))
            elif op in (SCHEMA, CHANNEL) and length < LARGEST_CHUNK:
                with contextlib.suppress(DamagedError):
                    self._learn(op, stream.read(length))
            at = end
        self._salvaged(cause, max(size - at, 0) + unread, self._loose)

    def _scan(self, content: bytes) -> tuple[Mapping[int, list[tuple[int, int]]], int]:
        messages: dict[int, list[tuple[int, int]]] = {}
        read = 0
        for op, at, end in _records(content):
            read = end
            if op == MESSAGE and end - at >= 22:
                number, _, time = _HEAD.unpack_from(content, at)
                messages.setdefault(number, []).append((time, at - 9))
            elif op in (SCHEMA, CHANNEL):
                with contextlib.suppress(DamagedError):
                    self._learn(op, content[at:end])
        return messages, read

    def _learn(self, op: int, content: bytes) -> None:
        """Take in a schema or a channel."""
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

    def _place(self, stream: BinaryIO, chunk: Chunk) -> tuple[str, int, int, int]:
        stream.seek(chunk.position + 9)
        head = stream.read(40 + 16)
        try:
            (size,) = struct.unpack_from("<Q", head, 16)
            compression, at = _string(head, 28)
            (packed,) = struct.unpack_from("<Q", head, at)
        except (struct.error, ValueError):
            raise DamagedError("a chunk makes no sense") from None
        packed = min(packed, max(0, chunk.length - at - 8))
        return compression, chunk.position + 9 + at + 8, packed, size

    def _index(self, stream: BinaryIO, chunk: Chunk) -> Entries:
        return {number: _entries(stream, at, number) for number, at in chunk.held.items()}

    def _block(self, content: Bytes, number: int, time: Index, offset: Index) -> Block:
        inside = (offset >= 0) & (offset + BEFORE_PAYLOAD <= len(content))
        offset, time = offset[inside], time[inside]
        end = offset + 9 + unsigned(content, offset + 1, 8)
        inside = (content[offset] == MESSAGE) & (unsigned(content, offset + 9, 2) == number)
        inside &= (end >= offset + BEFORE_PAYLOAD) & (end <= len(content))
        return Block(content, offset[inside] + BEFORE_PAYLOAD, end[inside], time[inside])


def _records(content: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield op, start and end of the content of each record, until one is cut."""
    at = 0
    while at + 9 <= len(content):
        op, length = struct.unpack_from("<BQ", content, at)
        if at + 9 + length > len(content):
            return
        yield op, at + 9, at + 9 + length
        at += 9 + length


def _string(content: bytes, at: int) -> tuple[str, int]:
    (length,) = struct.unpack_from("<I", content, at)
    if at + 4 + length > len(content):
        raise ValueError("a string is cut")
    return content[at + 4 : at + 4 + length].decode(errors="replace"), at + 4 + length


def _chunk_index(content: bytes, size: int) -> Chunk:
    try:
        start, end, position, length, indexes = struct.unpack_from("<QQQQI", content)
        pairs = content[36 : 36 + indexes]
        index_positions = dict(struct.iter_unpack("<HQ", pairs))
    except struct.error:
        raise DamagedError("its summary makes no sense") from None
    if position + length > size or length < 9 or any(at >= size for at in index_positions.values()):
        raise DamagedError("its summary points nowhere")
    return Chunk(position, length - 9, index_positions, start * 1e-9, end * 1e-9)


def _counts(content: bytes) -> dict[int, int]:
    if len(content) < 46 or (len(content) - 46) % 10:
        raise DamagedError("its statistics make no sense")
    return dict(struct.iter_unpack("<HQ", content[46:]))


def _entries(stream: BinaryIO, position: int, number: int) -> tuple[Index, Index]:
    """Read the times and offsets of one channel's messages in a chunk."""
    stream.seek(position)
    head = stream.read(15)
    if len(head) != 15:
        raise DamagedError("an index is missing")
    op, _, channel, length = struct.unpack("<BQHI", head)
    if op != INDEX or channel != number or length > LARGEST_CHUNK // 8:
        raise DamagedError("an index makes no sense")
    data = stream.read(length)
    if len(data) != length or length % 16:
        raise DamagedError("an index is cut")
    entries = np.frombuffer(data, dtype="<i8").reshape(-1, 2)
    return entries[:, 0].copy(), entries[:, 1].copy()

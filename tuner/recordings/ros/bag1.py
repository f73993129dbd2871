"""The ROS 1 bag container.

rosbags raises on a bag without its end or its index; here 14,002 of 28,007 messages of the shipped
circle bag cut in half are salvaged, and all of one that was never closed. rosbags unpacks any size
that a chunk claims: 6 kB of bzip2 took 2.1 GB there and take 34 MB here. The fields of a 51 MB bag
(308,077 messages) take 0.27 s and 79 MB, against 6.8 s and 211 MB message by message: array
operations locate the messages of a whole chunk.
"""

from __future__ import annotations

import contextlib
import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat
from rosbags.typesys.msg import normalize_msgtype

from tuner.core.errors import RecordingError
from tuner.recordings.notes import Cause
from tuner.recordings.recording import NS_PER_SECOND
from tuner.recordings.ros.container import (
    Chunk,
    ChunkedFile,
    ChunkIndex,
    Connection,
    Content,
    DamagedError,
    FileBytes,
    Record,
    RecordContent,
    unsigned,
)
from tuner.recordings.ros.messages import Bytes, Index, MessageBlock

MESSAGE, INDEX, CHUNK, CONNECTION = 2, 4, 5, 7

#: Record headers are some dozens of bytes; a connection's data hold its definition.
MAX_HEADER_BYTES = 1 << 16
MAX_RECORD_BYTES = 1 << 24


@dataclass
class Bag1(ChunkedFile):
    """A ROS 1 bag; the position of a chunk is that of its data."""

    ENTRY_BYTES = 12
    aligned: bool = False

    def __post_init__(self) -> None:
        with self.path.open("rb") as stream:
            magic = stream.readline(32)
            if not re.fullmatch(rb"#ROSBAG V2\.0\r?\n", magic):
                reason = "is empty" if not magic else "is no ROS 1 bag of version 2.0"
                raise RecordingError(self.path, reason, "give the recording itself")
            data = FileBytes(stream)
            self._read(data, len(magic), len(data), _known_damage(data, len(magic)))
        if not self.connections:
            raise RecordingError(self.path, "holds no messages", "record it again")

    def _records(self, data: Content, at: int) -> Iterator[Record]:
        with contextlib.suppress(DamagedError):
            while at < len(data):
                header, begin, end = _record(data, at)
                found: RecordContent = None
                kind = header.get(b"op")
                if kind == bytes([CHUNK]):
                    found = _chunk(header, begin, min(end, len(data)))
                elif kind == bytes([INDEX]):
                    found = ChunkIndex(_number(header, b"conn", 4), begin, end)
                elif kind == bytes([MESSAGE]):
                    time = _number(header, b"time", 8)  # seconds, and nanoseconds above them
                    nanoseconds = (time & 0xFFFF_FFFF) * NS_PER_SECOND + (time >> 32)
                    found = _number(header, b"conn", 4), nanoseconds
                elif kind == bytes([CONNECTION]) and end <= min(
                    len(data), begin + MAX_RECORD_BYTES
                ):
                    known = _connection(header, data[begin:end])
                    self.connections.setdefault(known.id, known)
                yield at, end, found
                at = end

    def _entries(self, content: bytes) -> tuple[Index, Index]:
        entries = np.frombuffer(content, dtype="<u4").reshape(-1, 3).astype(np.int64)
        return entries[:, 0] * NS_PER_SECOND + entries[:, 1], entries[:, 2]

    def _block(self, content: Bytes, number: int, time: Index, offset: Index) -> MessageBlock:
        length = len(content)
        inside = (offset >= 0) & (offset + 4 <= length)
        offset, time = offset[inside], time[inside]
        size = unsigned(content, offset, 4)
        inside = (offset + 8 + size <= length) & (size < MAX_HEADER_BYTES)
        offset, time, size = offset[inside], time[inside], size[inside]
        start = offset + 8 + size
        end = start + unsigned(content, start - 4, 4)
        inside = (end <= length) & _is_of(content, number, offset + 4, size)
        return MessageBlock(content, start[inside], end[inside], time[inside])


Header = dict[bytes, bytes]
"""Of a record: name -> value."""


def _record(data: Content, at: int) -> tuple[Header, int, int]:
    """Return a record's header, and where its data begin and end, perhaps after the file's end."""
    begin = at + 8 + _length(data, at)
    if begin > at + 8 + MAX_HEADER_BYTES:
        raise DamagedError("a record header is absurdly long")
    return _header(data[at + 4 : begin - 4]), begin, begin + _length(data, begin - 4)


def _known_damage(data: FileBytes, first: int) -> Cause | None:
    """Return the damage that the bag's first record shows, by the place of the bag's end."""
    try:
        at = _number(_record(data, first)[0], b"index_pos", 8)
    except DamagedError:
        return Cause.INDEX_DAMAGED
    if at == 0:
        return Cause.NOT_CLOSED
    return Cause.END_MISSING if at >= len(data) else None


def _length(data: Content, at: int) -> int:
    raw = data[at : at + 4]
    if len(raw) < 4:
        raise DamagedError("it ends in the middle of a record")
    return int.from_bytes(raw, "little")


def _header(raw: bytes) -> Header:
    """Split a record header into its ``name=value`` fields."""
    fields = {}
    at = 0
    while at + 4 <= len(raw):
        size = _length(raw, at)
        name, equals, value = raw[at + 4 : at + 4 + size].partition(b"=")
        if not equals or at + 4 + size > len(raw):
            raise DamagedError("a record header makes no sense")
        fields[name] = value
        at += 4 + size
    return fields


def _number(header: Header, name: bytes, size: int) -> int:
    value = header.get(name, b"")
    if len(value) != size:
        raise DamagedError(f"a record lacks its '{name.decode()}'")
    return int.from_bytes(value, "little")


def _connection(header: Header, data: bytes) -> Connection:
    inner = _header(data)
    try:
        topic = header[b"topic"].decode()
        kind = normalize_msgtype(inner[b"type"].decode())
        text = inner[b"message_definition"].decode(errors="replace")
    except (KeyError, UnicodeDecodeError, ValueError):
        raise DamagedError("a connection record makes no sense") from None
    definition = MessageDefinition(MessageDefinitionFormat.MSG, text)
    return Connection(_number(header, b"conn", 4), "/" + topic.strip("/"), kind, definition, 0)


def _chunk(header: Header, begin: int, end: int) -> Chunk:
    compression = header.get(b"compression", b"").decode(errors="replace")
    size = _number(header, b"size", 4)
    return Chunk(begin, end - begin, compression=compression, size=size)


def _is_of(content: Bytes, connection: int, header: Index, size: Index) -> NDArray[np.bool_]:
    """Return which record headers name a connection; those of one length have one layout."""
    belongs = np.zeros(len(header), dtype=np.bool_)
    if len(header) == 0:
        return belongs
    name = b"conn=" + struct.pack("<I", connection)
    alike = int(size.min()) == int(size.max())
    for length in size[:1] if alike else np.unique(size):
        rows = np.flatnonzero(size == length)
        first = content[header[rows[0]] : header[rows[0]] + length].tobytes()
        at = first.find(name)
        if at >= 0:
            belongs[rows] = unsigned(content, header[rows] + at + 5, 4) == connection
    return belongs

"""The ROS 1 bag container: read by its index, or walked from the front where that is lost.

rosbags raises on a bag without its end or its index; of the shipped circle bag cut in half 14,002
of 28,007 messages are salvaged here, and all of one that was never closed. rosbags unpacks whatever
a chunk claims: 6 kB of bzip2 took 2.1 GB there and take 34 MB here. The fields of a 51 MB bag
(308,077 messages) are read in 0.27 s and 79 MB, against 6.8 s and 211 MB message by message, since
chunks are read whole and messages located with array operations.
"""

from __future__ import annotations

import contextlib
import re
import struct
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat
from rosbags.typesys.msg import normalize_msgtype

from tuner.core.errors import RecordingError
from tuner.recordings.notes import Cause
from tuner.recordings.ros.container import (
    Chunk,
    ChunkedFile,
    Connection,
    DamagedError,
    Entries,
    unsigned,
)
from tuner.recordings.ros.messages import Block, Bytes, Index

MESSAGE, BAG, INDEX, CHUNK, CHUNK_INFO, CONNECTION = 2, 3, 4, 5, 6, 7

#: Record headers are some dozens of bytes; a connection's holds its definition beside it.
LONGEST_HEADER = 1 << 16
LONGEST_DATA = 1 << 24


@dataclass
class Bag1(ChunkedFile):
    """A ROS 1 bag, whose chunks' positions are those of their data."""

    aligned: bool = False

    def __post_init__(self) -> None:
        with self.path.open("rb") as stream:
            magic = stream.readline(32)
            if not re.fullmatch(rb"#ROSBAG V2\.0\r?\n", magic):
                reason = "is empty" if not magic else "is no ROS 1 bag of version 2.0"
                raise RecordingError(self.path, reason, "give the recording itself")
            first = stream.tell()
            try:
                self._read_index(stream)
            except DamagedError as err:
                self._walk(stream, first, err.cause)
        if not self.connections:
            raise RecordingError(self.path, "holds no messages", "record it again")

    def _lost(self, chunks: Sequence[Chunk], wanted: Collection[int]) -> int:
        return sum(chunk.held.get(number, 0) for chunk in chunks for number in wanted)

    def _read_index(self, stream: BinaryIO) -> None:
        """Learn connections and chunks from the end of the bag."""
        header, _ = _record(stream, BAG)
        start = _number(header, b"index_pos", 8)
        connections = _number(header, b"conn_count", 4)
        chunks = _number(header, b"chunk_count", 4)
        size = self.path.stat().st_size
        if start == 0:
            raise DamagedError("it has no index", Cause.NOT_CLOSED)
        if start >= size or connections > size // 20 or chunks > size // 20:
            raise DamagedError("its end is missing", Cause.END_MISSING)
        stream.seek(start)
        records = [_connection(*_record(stream, CONNECTION)) for _ in range(connections)]
        infos = [_chunk_info(*_record(stream, CHUNK_INFO)) for _ in range(chunks)]
        counts: Counter[int] = Counter()
        for position, info in infos:
            stream.seek(position)
            header, packed = _header(stream, CHUNK)
            self._chunks.append(replace(_chunk(header, stream.tell(), packed), **info))
            counts.update(info["held"])
        self.connections = {record.id: record for record in records}
        self._count(counts)

    def _walk(self, stream: BinaryIO, first: int, cause: Cause) -> None:
        """Learn connections and chunks from front to end, as far as records can be followed."""
        self._chunks, self.connections = [], {}
        size = self.path.stat().st_size
        stream.seek(first)
        reached, unread = first, 0
        with contextlib.suppress(DamagedError):
            while reached < size:
                header, length = _header(stream, None)
                position = stream.tell()
                if header.get(b"op") == bytes([CHUNK]):
                    chunk = _chunk(header, position, min(length, size - position))
                    unread += self._add(stream, chunk)
                reached = min(position + length, size)
                stream.seek(reached)
        self._salvaged(cause, size - reached + unread, {})

    def _place(self, stream: BinaryIO, chunk: Chunk) -> tuple[str, int, int, int]:  # noqa: ARG002
        return chunk.compression, chunk.position, chunk.length, chunk.size

    def _index(self, stream: BinaryIO, chunk: Chunk) -> Entries:
        stream.seek(chunk.position + chunk.length)
        return dict(_entries(stream) for _ in range(len(chunk.held)))

    def _scan(self, content: bytes) -> tuple[Mapping[int, list[tuple[int, int]]], int]:
        messages: dict[int, list[tuple[int, int]]] = {}
        at = read = 0
        while at + 8 <= len(content):
            (size,) = struct.unpack_from("<I", content, at)
            start = at + 8 + size
            if size > LONGEST_HEADER or start > len(content):
                break
            try:
                header = _fields(content[at + 4 : start - 4])
            except DamagedError:
                break
            (length,) = struct.unpack_from("<I", content, start - 4)
            if start + length > len(content):
                break
            if header.get(b"op") == bytes([CONNECTION]):
                record = _connection(header, content[start : start + length])
                self.connections.setdefault(record.id, record)
            elif header.get(b"op") == bytes([MESSAGE]):
                time = _time(header.get(b"time", b""))
                messages.setdefault(_number(header, b"conn", 4), []).append((time, at))
            at = read = start + length
        return messages, read

    def _block(self, content: Bytes, number: int, time: Index, offset: Index) -> Block:
        length = len(content)
        inside = (offset >= 0) & (offset + 4 <= length)
        offset, time = offset[inside], time[inside]
        size = unsigned(content, offset, 4)
        inside = (offset + 8 + size <= length) & (size < LONGEST_HEADER)
        offset, time, size = offset[inside], time[inside], size[inside]
        start = offset + 8 + size
        end = start + unsigned(content, start - 4, 4)
        inside = (end <= length) & _belongs(content, number, offset + 4, size)
        return Block(content, start[inside], end[inside], time[inside])


def _read(stream: BinaryIO, size: int) -> bytes:
    data = stream.read(size)
    if len(data) != size:
        raise DamagedError("it ends in the middle of a record")
    return data


def _fields(raw: bytes) -> dict[bytes, bytes]:
    """Split a record header into its ``name=value`` fields."""
    fields = {}
    at = 0
    while at + 4 <= len(raw):
        (size,) = struct.unpack_from("<I", raw, at)
        name, equals, value = raw[at + 4 : at + 4 + size].partition(b"=")
        if not equals or at + 4 + size > len(raw):
            raise DamagedError("a record header makes no sense")
        fields[name] = value
        at += 4 + size
    return fields


def _header(stream: BinaryIO, op: int | None) -> tuple[dict[bytes, bytes], int]:
    """Read the header of a record, and how long its data are."""
    (size,) = struct.unpack("<I", _read(stream, 4))
    if size > LONGEST_HEADER:
        raise DamagedError("a record header is absurdly long")
    fields = _fields(_read(stream, size))
    if op is not None and fields.get(b"op") != bytes([op]):
        raise DamagedError("its index points nowhere")
    return fields, int.from_bytes(_read(stream, 4), "little")


def _record(stream: BinaryIO, op: int) -> tuple[dict[bytes, bytes], bytes]:
    header, size = _header(stream, op)
    if size > LONGEST_DATA:
        raise DamagedError("a record is absurdly long")
    return header, _read(stream, size)


def _number(header: dict[bytes, bytes], name: bytes, size: int) -> int:
    value = header.get(name, b"")
    if len(value) != size:
        raise DamagedError(f"a record lacks its '{name.decode()}'")
    return int.from_bytes(value, "little")


def _time(value: bytes) -> int:
    if len(value) != 8:
        raise DamagedError("a message lacks its time")
    seconds, nanoseconds = struct.unpack("<II", value)
    return int(seconds) * 1_000_000_000 + int(nanoseconds)


def _connection(header: dict[bytes, bytes], data: bytes) -> Connection:
    inner = _fields(data)
    try:
        topic = header[b"topic"].decode()
        kind = normalize_msgtype(inner[b"type"].decode())
        text = inner[b"message_definition"].decode(errors="replace")
    except (KeyError, UnicodeDecodeError, ValueError):
        raise DamagedError("a connection record makes no sense") from None
    definition = MessageDefinition(MessageDefinitionFormat.MSG, text)
    return Connection(_number(header, b"conn", 4), "/" + topic.strip("/"), kind, definition, 0)


def _chunk_info(header: dict[bytes, bytes], data: bytes) -> tuple[int, dict[str, Any]]:
    """Return where a chunk lies, and its messages, start and end as the index has them."""
    if len(data) % 8:
        raise DamagedError("a chunk's entry in the index makes no sense")
    start, end = (_time(header.get(name, b"")) * 1e-9 for name in (b"start_time", b"end_time"))
    held = dict(struct.iter_unpack("<II", data))
    return _number(header, b"chunk_pos", 8), {"held": held, "start": start, "end": end}


def _chunk(header: dict[bytes, bytes], position: int, packed: int) -> Chunk:
    compression = header.get(b"compression", b"").decode(errors="replace")
    size = _number(header, b"size", 4)
    return Chunk(position, packed, {}, compression=compression, size=size)


def _entries(stream: BinaryIO) -> tuple[int, tuple[Index, Index]]:
    """Read the index of one connection in a chunk: its number, times and offsets."""
    header, data = _record(stream, INDEX)
    if len(data) % 12:
        raise DamagedError("an index makes no sense")
    entries = np.frombuffer(data, dtype="<u4").reshape(-1, 3).astype(np.int64)
    time = entries[:, 0] * 1_000_000_000 + entries[:, 1]
    return _number(header, b"conn", 4), (time, entries[:, 2])


def _belongs(content: Bytes, connection: int, header: Index, size: Index) -> NDArray[np.bool_]:
    """Return which record headers name a connection; those of one length are laid out alike."""
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

"""The interface of ROS containers: connections, and blocks of their messages."""

from __future__ import annotations

import importlib
import io
import sys
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, BinaryIO, ClassVar

import numpy as np
from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat

from tuner.recordings.notes import Cause, Damage
from tuner.recordings.ros.messages import Bytes, Index, MessageBlock

#: A larger chunk is not unpacked: those of cameras and lidars are far smaller.
MAX_CHUNK_BYTES = 128 << 20
#: Messages outside of chunks are read in groups of so many.
LOOSE_PER_CHUNK = 4096
#: Pieces of an uncompressed chunk that are this near are read together.
MAX_READ_GAP_BYTES = 1 << 16


DEFINITION_FORMATS = {
    "ros2msg": MessageDefinitionFormat.MSG,
    "ros1msg": MessageDefinitionFormat.MSG,
    "ros2idl": MessageDefinitionFormat.IDL,
    "omgidl": MessageDefinitionFormat.IDL,
}
NO_DEFINITION = MessageDefinition(MessageDefinitionFormat.NONE, "")


class FileBytes:
    """A file as bytes that are read on demand."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self._size = stream.seek(0, io.SEEK_END)

    def __len__(self) -> int:
        return self._size

    def __getitem__(self, part: slice) -> bytes:
        self._stream.seek(part.start)
        return self._stream.read(max(0, min(part.stop, self._size) - part.start))


Content = bytes | FileBytes
"""The bytes of records: a file, or an unpacked chunk."""


@dataclass(frozen=True)
class Connection:
    """A topic as one publisher wrote it."""

    id: int
    topic: str
    type: str
    definition: MessageDefinition
    count: int


@dataclass
class Container(ABC):
    """A file, or a folder of them, that holds serialised messages.

    Attributes
    ----------
    aligned
        Whether messages are CDR (ROS 2), else ROS 1.
    damage
        What could not be read so far.

    Raises
    ------
    RecordingError
        It is no such container, or nothing of it can be read.
    """

    path: Path
    aligned: bool = True
    connections: dict[int, Connection] = field(default_factory=dict)
    damage: list[Damage] = field(default_factory=list)

    @abstractmethod
    def blocks(self, wanted: Collection[int]) -> Iterator[tuple[int, MessageBlock]]:
        """Yield the messages of some connections, each block of one connection."""


class DamagedError(Exception):
    """The container is damaged here."""


def unpack(compression: str, packed: bytes, size: int) -> bytes:
    """Unpack a chunk, or its beginning if it is cut, up to the size that it claims.

    Raises
    ------
    DamagedError
        The compression is unknown, the size absurd or nothing can be unpacked.
    """
    if not 0 < size <= MAX_CHUNK_BYTES:
        raise DamagedError(f"a chunk claims {size} bytes")
    if compression not in _DECOMPRESSORS:
        raise DamagedError(f"unknown compression '{compression[:20]}'")
    try:
        unpacked: bytes = _DECOMPRESSORS[compression]()().decompress(packed, max_length=size)
    except Exception as err:  # each library has its own errors
        raise DamagedError(f"a chunk cannot be unpacked ({err})") from None
    return unpacked


def zstd() -> Any:
    """Return the zstd module: Python's own from 3.14 on, before that the one of rosbags."""
    if sys.version_info >= (3, 14):
        return importlib.import_module("compression.zstd")
    return importlib.import_module("backports.zstd")


_DECOMPRESSORS: Mapping[str, Callable[[], Any]] = {
    "bz2": lambda: importlib.import_module("bz2").BZ2Decompressor,
    "lz4": lambda: importlib.import_module("lz4.frame").LZ4FrameDecompressor,
    "zstd": lambda: zstd().ZstdDecompressor,
}
"""Compression -> its class, imported on demand."""


def unsigned(buffer: Bytes, at: Index, size: int) -> Index:
    """Read little-endian numbers of some bytes at positions that lie inside a buffer."""
    spread = buffer[at[:, None] + np.arange(size)]
    return np.asarray(spread.view(f"<u{size}")[:, 0].astype(np.int64), dtype=np.int64)


def block_of(times: Sequence[int], payloads: Sequence[bytes]) -> MessageBlock:
    """Return messages as one block."""
    lengths = np.array([len(payload) for payload in payloads], dtype=np.int64)
    end = np.cumsum(lengths)
    content = np.frombuffer(b"".join(payloads), dtype=np.uint8)
    return MessageBlock(content, end - lengths, end, np.array(times, dtype=np.int64))


Entries = Mapping[int, tuple[Index, Index]]
"""Connection -> times (n,) ns and offsets (n,) of its messages' records in a chunk."""


@dataclass(frozen=True)
class Chunk:
    """A chunk of a file with messages of several connections.

    Attributes
    ----------
    position, length
        Of its data in the file, in bytes.
    compression, size
        The compression of its data, and their unpacked bytes.
    held
        Connection -> its number of messages in the chunk.
    indexes
        Connection -> begin and end of its messages' times and offsets after the chunk.
    entries
        Its messages, if the chunk was walked.
    """

    position: int
    length: int
    compression: str = ""
    size: int = 0
    held: dict[int, int] = field(default_factory=dict)
    indexes: dict[int, tuple[int, int]] = field(default_factory=dict)
    entries: Entries = field(default_factory=dict)

    @property
    def packed(self) -> bool:
        """Whether its data are compressed."""
        return self.compression not in ("none", "")

    def holding(self, rows: Mapping[int, Sequence[tuple[int, int]]]) -> Chunk:
        """Return the chunk with the messages of a walk: connection -> times and offsets."""
        tables = {number: np.array(held, dtype=np.int64).T for number, held in rows.items()}
        entries = {number: (time, offset) for number, (time, offset) in tables.items()}
        return replace(self, held={n: len(held) for n, held in rows.items()}, entries=entries)


@dataclass(frozen=True)
class ChunkIndex:
    """The place of the times and offsets of a connection's messages in the chunk before."""

    connection: int
    begin: int
    end: int


RecordContent = Chunk | ChunkIndex | tuple[int, int] | None
"""A chunk, an index after it, a message (its connection, and ns), or another record."""
Record = tuple[int, int, RecordContent]
"""Begin, end and content of a record."""


@dataclass
class ChunkedFile(Container):
    """A container of chunks, each with an index after it, read from the front.

    Chunks without an index, and all of a damaged file, are walked message by message. Messages
    outside of chunks become chunks of some thousands.

    Attributes
    ----------
    ENTRY_BYTES
        Size of a message's entry in an index.
    """

    ENTRY_BYTES: ClassVar[int]
    _chunks: list[Chunk] = field(default_factory=list)

    @abstractmethod
    def _entries(self, content: bytes) -> tuple[Index, Index]:
        """Return the times and offsets of one connection's messages from its index."""

    @abstractmethod
    def _records(self, data: Content, at: int) -> Iterator[Record]:
        """Yield the records from a position on, up to damage; the last may be cut.

        Connections are read on the way.
        """

    @abstractmethod
    def _block(self, content: Bytes, number: int, time: Index, offset: Index) -> MessageBlock:
        """Return the payloads of a connection's messages from the offsets of their records."""

    def blocks(self, wanted: Collection[int]) -> Iterator[tuple[int, MessageBlock]]:
        """Yield the messages of some connections, chunk by chunk."""
        lost: list[Chunk] = []
        with self.path.open("rb") as stream:
            data = FileBytes(stream)
            for chunk in self._chunks:
                present = [number for number in wanted if number in chunk.held]
                try:
                    located = self._locate(data, chunk, present) if present else []
                except DamagedError:
                    lost.append(chunk)
                    continue
                yield from located
            indexes = [self._index(data, chunk).values() for chunk in lost]
        if lost:
            times = [time * 1e-9 for index in indexes for time, _ in index if len(time)]
            self.damage.append(
                Damage(
                    Cause.CHUNKS_DAMAGED,
                    lost=sum(chunk.held.get(number, 0) for chunk in lost for number in wanted),
                    bytes_lost=sum(chunk.length for chunk in lost),
                    occurrences=len(lost),
                    start=min((float(time.min()) for time in times), default=None),
                    end=max((float(time.max()) for time in times), default=None),
                )
            )

    def _locate(
        self, data: FileBytes, chunk: Chunk, wanted: list[int]
    ) -> list[tuple[int, MessageBlock]]:
        """Return the blocks of a chunk, by the index after it or by a walk."""
        entries = chunk.entries or self._index(data, chunk) or self._walked(data, chunk)[0].entries
        if chunk.packed or chunk.length < 4 * MAX_READ_GAP_BYTES:
            content = np.frombuffer(_unpacked(data, chunk), dtype=np.uint8)
        else:  # only the wanted pieces of one that may hold images unpacked
            content, entries = read_wanted(data, chunk, entries, wanted)
        return [(n, self._block(content, n, *entries[n])) for n in entries if n in wanted]

    def _index(self, data: FileBytes, chunk: Chunk) -> Entries:
        """Return the messages of a chunk from the index after it; none if it is damaged."""
        if any((end - begin) % self.ENTRY_BYTES for begin, end in chunk.indexes.values()):
            return {}
        return {n: self._entries(data[begin:end]) for n, (begin, end) in chunk.indexes.items()}

    def _walked(self, data: FileBytes, chunk: Chunk) -> tuple[Chunk, int]:
        """Return a chunk with the messages of a walk, and its number of damaged bytes."""
        content, rows, read = _unpacked(data, chunk), dict[int, list[tuple[int, int]]](), 0
        for at, end, found in self._records(content, 0):
            if end > len(content):
                break
            if isinstance(found, tuple):
                rows.setdefault(found[0], []).append((found[1], at))
            read = end
        return chunk.holding(rows), len(content) - read

    def _read(self, data: FileBytes, first: int, last: int, cause: Cause | None) -> None:
        """Read connections and chunks, count messages, and note the damage.

        Parameters
        ----------
        first, last
            Where the records begin and end.
        cause
            Known damage of the file.
        """
        lost = last - self._scan(data, first)
        whole = cause is None and lost == 0 and bool(self.connections)
        for place, chunk in enumerate(self._chunks):
            if chunk.entries or (whole and chunk.held):
                continue
            try:
                self._chunks[place], missed = self._walked(data, chunk)
                lost += 0 if chunk.packed else missed  # of the file, not unpacked
            except DamagedError:
                self._chunks[place] = replace(chunk, held={})
                lost += chunk.length
        counts: Counter[int] = Counter()
        for chunk in self._chunks:
            counts.update(chunk.held)
        self.connections = {
            number: replace(known, count=counts[number])
            for number, known in self.connections.items()
        }
        if lost or cause is not None:
            times = [time.max() for chunk in self._chunks for time, _ in chunk.entries.values()]
            start = max(times) * 1e-9 if times else None
            cause, salvaged = cause or Cause.INDEX_DAMAGED, sum(counts.values())
            self.damage.append(Damage(cause, salvaged=salvaged, bytes_lost=lost, start=start))

    def _scan(self, data: FileBytes, first: int) -> int:
        """Read connections, chunks and their indexes; return where the last record ends."""
        loose: dict[int, list[tuple[int, int]]] = {}
        reached = first
        for at, end, found in self._records(data, first):
            if end > len(data) and not isinstance(found, Chunk):
                break
            if loose and (
                isinstance(found, Chunk) or sum(map(len, loose.values())) >= LOOSE_PER_CHUNK
            ):
                self._chunks.append(Chunk(0, reached).holding(loose))
                loose = {}
            if isinstance(found, tuple):
                loose.setdefault(found[0], []).append((found[1], at))
            elif isinstance(found, Chunk):
                self._chunks.append(found)
            elif found is not None and self._chunks:
                number, size = found.connection, found.end - found.begin
                self._chunks[-1].indexes[number] = found.begin, found.end
                self._chunks[-1].held[number] = size // self.ENTRY_BYTES
            reached = min(end, len(data))
        if loose:
            self._chunks.append(Chunk(0, reached).holding(loose))
        return reached


def _unpacked(data: FileBytes, chunk: Chunk) -> bytes:
    """Return the records of a chunk."""
    if chunk.length > MAX_CHUNK_BYTES:
        raise DamagedError(f"a chunk claims {chunk.length} bytes")
    content = data[chunk.position : chunk.position + chunk.length]
    return unpack(chunk.compression, content, chunk.size) if chunk.packed else content


def read_wanted(
    data: FileBytes, chunk: Chunk, entries: Entries, wanted: Collection[int]
) -> tuple[Bytes, Entries]:
    """Read the wanted connections' records of an unpacked chunk, and not the images between them.

    Returns
    -------
    tuple
        The bytes read, and the wanted entries with their offsets in them.
    """
    kept = {number: entry for number, entry in entries.items() if number in wanted}
    offsets = [offset for _, offset in kept.values() if len(offset)]
    starts = np.unique(np.concatenate(offsets)) if offsets else np.zeros(0, dtype=np.int64)
    if not offsets or starts[0] < 0 or starts[-1] >= chunk.length:
        raise DamagedError("an index points nowhere")
    bounds = np.unique(np.concatenate([offset for _, offset in entries.values()]))
    bounds = np.append(bounds[bounds < chunk.length], chunk.length)
    ends = bounds[np.searchsorted(bounds, starts, side="right")]
    first = np.concatenate([[0], np.flatnonzero(starts[1:] - ends[:-1] > MAX_READ_GAP_BYTES) + 1])
    last = np.append(first[1:], len(starts)) - 1
    lengths = ends[last] - starts[first]
    if lengths.sum() > MAX_CHUNK_BYTES:
        raise DamagedError("a chunk is absurdly long")
    begins = chunk.position + starts[first]
    pieces = [data[at : at + n] for at, n in zip(begins.tolist(), lengths.tolist(), strict=True)]
    piece = np.searchsorted(first, np.arange(len(starts)), side="right") - 1
    moved = starts + (np.cumsum(lengths) - lengths - starts[first])[piece]
    return np.frombuffer(b"".join(pieces), dtype=np.uint8), {
        number: (time, moved[np.searchsorted(starts, offset)])
        for number, (time, offset) in kept.items()
    }

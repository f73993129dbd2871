"""The interface of ROS containers: connections, and blocks of their messages."""

from __future__ import annotations

import contextlib
import importlib
import io
import sys
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from rosbags.interfaces import MessageDefinition

from tuner.recordings.notes import Cause, Damage
from tuner.recordings.ros.messages import Block, Bytes, Index

#: A larger chunk is not unpacked: those of cameras and lidars are far smaller.
MAX_CHUNK_BYTES = 128 << 20
#: Messages outside of chunks are read in groups of so many.
LOOSE_PER_CHUNK = 4096
#: Pieces of an uncompressed chunk that are this near are read together.
MAX_READ_GAP_BYTES = 1 << 16


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
    def blocks(self, wanted: Collection[int]) -> Iterator[tuple[int, Block]]:
        """Yield the messages of some connections, each block of one connection."""


class DamagedError(Exception):
    """The container is damaged here.

    Parameters
    ----------
    cause
        The damage of the recording, if the error makes its index unusable.
    """

    def __init__(self, text: str, cause: Cause = Cause.INDEX_DAMAGED) -> None:
        super().__init__(text)
        self.cause = cause


def unpack(compression: str, packed: bytes, size: int) -> bytes:
    """Unpack a chunk, or its beginning if it is cut, up to the size that it claims.

    Raises
    ------
    DamagedError
        The compression is unknown, the size absurd or nothing can be unpacked.
    """
    if not 0 < size <= MAX_CHUNK_BYTES:
        raise DamagedError(f"a chunk claims {size} bytes")
    try:
        if compression == "bz2":
            from bz2 import BZ2Decompressor  # noqa: PLC0415 (each on demand)

            return BZ2Decompressor().decompress(packed, max_length=size)
        if compression == "lz4":
            lz4 = importlib.import_module("lz4.frame")
            unpacked: bytes = lz4.LZ4FrameDecompressor().decompress(packed, max_length=size)
            return unpacked
        if compression == "zstd":
            content: bytes = zstd().ZstdDecompressor().decompress(packed, max_length=size)
            return content
    except Exception as err:  # each library has its own errors
        raise DamagedError(f"a chunk cannot be unpacked ({err})") from None
    raise DamagedError(f"unknown compression '{compression[:20]}'")


def zstd() -> Any:
    """Return the zstd module: Python's own from 3.14 on, before that the one of rosbags."""
    if sys.version_info >= (3, 14):
        return importlib.import_module("compression.zstd")
    return importlib.import_module("backports.zstd")


def unsigned(buffer: Bytes, at: Index, size: int) -> Index:
    """Read little-endian numbers of some bytes at positions that lie inside a buffer."""
    spread = buffer[at[:, None] + np.arange(size)]
    return np.asarray(spread.view(f"<u{size}")[:, 0].astype(np.int64), dtype=np.int64)


def block_of(times: Sequence[int], payloads: Sequence[bytes]) -> Block:
    """Return messages as one block."""
    lengths = np.array([len(payload) for payload in payloads], dtype=np.int64)
    end = np.cumsum(lengths)
    content = np.frombuffer(b"".join(payloads), dtype=np.uint8)
    return Block(content, end - lengths, end, np.array(times, dtype=np.int64))


Entries = Mapping[int, tuple[Index, Index]]
"""Connection -> times (n,) ns and offsets (n,) of its messages' records in a chunk."""


@dataclass(frozen=True)
class Chunk:
    """A chunk of a file with messages of several connections.

    Attributes
    ----------
    position, length
        Of its data in the file, in bytes.
    held
        Connection -> its number of messages in the chunk, or another mark of their presence.
    start, end
        s since 1970 of the first and the last message; None without an index.
    compression, size
        The compression of its data, and their unpacked bytes.
    entries
        Its messages, if the chunk was walked; else they are in its index.
    """

    position: int
    length: int
    held: Mapping[int, int] = field(default_factory=dict)
    start: float | None = None
    end: float | None = None
    compression: str = ""
    size: int = 0
    entries: Entries = field(default_factory=dict)

    @property
    def packed(self) -> bool:
        """Whether its data are compressed."""
        return self.compression not in ("none", "")

    def holding(self, rows: Mapping[int, Sequence[tuple[int, int]]]) -> Chunk:
        """Return the chunk with the messages of a walk: connection -> times and offsets."""
        tables = {number: np.array(held, dtype=np.int64).T for number, held in rows.items()}
        last = max((int(time.max()) for time, _ in tables.values()), default=None)
        return replace(
            self,
            held={number: len(held) for number, held in rows.items()},
            end=None if last is None else last * 1e-9,
            entries={number: (time, offset) for number, (time, offset) in tables.items()},
        )


RecordContent = Chunk | tuple[int, int] | None
"""A chunk, a message (its connection, and ns), or another record."""
Record = tuple[int, int, RecordContent]
"""Begin, end and content of a record."""


@dataclass
class ChunkedFile(Container):
    """A container of chunks: read by its indexes, or walked from the front without them.

    Messages outside of chunks become chunks of some thousands.
    """

    _chunks: list[Chunk] = field(default_factory=list)

    @abstractmethod
    def _index(self, data: FileBytes, chunk: Chunk) -> Entries:
        """Return the messages of a chunk from the index after it."""

    @abstractmethod
    def _records(self, data: Content, at: int) -> Iterator[Record]:
        """Yield the records from a position on, up to damage; the last may be cut.

        Connections are read on the way.
        """

    @abstractmethod
    def _block(self, content: Bytes, number: int, time: Index, offset: Index) -> Block:
        """Return the payloads of a connection's messages from the offsets of their records."""

    def _count_lost(self, chunks: Sequence[Chunk], wanted: Collection[int]) -> int | None:  # noqa: ARG002
        """Return how many wanted messages some chunks held; None if unknown."""
        return None

    def blocks(self, wanted: Collection[int]) -> Iterator[tuple[int, Block]]:
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
        if lost:
            self.damage.append(
                Damage(
                    Cause.CHUNKS_DAMAGED,
                    lost=self._count_lost(lost, wanted),
                    bytes_lost=sum(chunk.length for chunk in lost),
                    occurrences=len(lost),
                    start=min((chunk.start for chunk in lost if chunk.start), default=None),
                    end=max((chunk.end for chunk in lost if chunk.end), default=None),
                )
            )

    def _locate(self, data: FileBytes, chunk: Chunk, wanted: list[int]) -> list[tuple[int, Block]]:
        """Return the blocks of a chunk, by the index after it or by a walk."""
        try:
            entries = chunk.entries or self._index(data, chunk)
        except DamagedError:
            entries = self._walked(data, chunk)[0].entries
        if chunk.packed or chunk.length < 4 * MAX_READ_GAP_BYTES:
            content = np.frombuffer(_unpacked(data, chunk), dtype=np.uint8)
        else:  # only the wanted pieces of one that may hold images unpacked
            content, entries = read_wanted(data, chunk, entries, wanted)
        return [(n, self._block(content, n, *entries[n])) for n in entries if n in wanted]

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

    def _walk(self, data: FileBytes, first: int, cause: Cause) -> None:
        """Read connections and chunks from the front, count messages, and note the damage."""
        self._chunks, self.connections = [], {}
        loose: dict[int, list[tuple[int, int]]] = {}
        reached, lost = first, 0
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
            elif found is not None:
                chunk, missed = found, found.length
                with contextlib.suppress(DamagedError):
                    chunk, missed = self._walked(data, chunk)
                self._chunks.append(chunk)
                lost += 0 if chunk.packed else missed  # of the file, not unpacked
            reached = min(end, len(data))
        if loose:
            self._chunks.append(Chunk(0, reached).holding(loose))
        counts: Counter[int] = Counter()
        for chunk in self._chunks:
            counts.update(chunk.held)
        start = max((chunk.end for chunk in self._chunks if chunk.end is not None), default=None)
        self._set_counts(counts)
        lost += len(data) - reached
        self.damage.append(
            Damage(cause, salvaged=sum(counts.values()), bytes_lost=lost, start=start)
        )

    def _set_counts(self, counts: Mapping[int, int]) -> None:
        """Set the number of messages of each connection."""
        self.connections = {
            number: replace(known, count=counts.get(number, 0))
            for number, known in self.connections.items()
        }


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

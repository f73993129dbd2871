"""What the ROS containers have in common: connections, and blocks of their messages."""

from __future__ import annotations

import contextlib
import importlib
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

#: The largest chunk that is unpacked: cameras and lidars stay far below it.
LARGEST_CHUNK = 128 << 20
#: Wanted pieces of an uncompressed chunk that lie this near are read in one go, in bytes.
NEAR = 1 << 16


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
    path
        Where it lies.
    aligned
        Whether messages are CDR (ROS 2), else ROS 1.
    connections
        By their number.
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
    """The container's structure cannot be followed here.

    Parameters
    ----------
    text
        Why.
    cause
        What that says of the recording, where the error ends the use of its index.
    """

    def __init__(self, text: str, cause: Cause = Cause.INDEX_DAMAGED) -> None:
        super().__init__(text)
        self.cause = cause


def unpack(compression: str, packed: bytes, size: int) -> bytes:
    """Unpack a chunk, or as much of it as is there, never beyond the size it claims.

    Raises
    ------
    DamagedError
        The compression is unknown, the size absurd or nothing can be unpacked.
    """
    if compression in ("none", ""):
        return packed
    if not 0 < size <= LARGEST_CHUNK:
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
    except Exception as err:  # each library has its own, and none is a fault of ours
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


def joined(times: Sequence[int], payloads: Sequence[bytes]) -> Block:
    """Return a block of messages that were read one by one."""
    lengths = np.array([len(payload) for payload in payloads], dtype=np.int64)
    end = np.cumsum(lengths)
    content = np.frombuffer(b"".join(payloads), dtype=np.uint8)
    return Block(content, end - lengths, end, np.array(times, dtype=np.int64))


Entries = Mapping[int, tuple[Index, Index]]
"""Connection -> times (n,) ns and offsets (n,) of its messages' records in a chunk."""


@dataclass(frozen=True)
class Chunk:
    """A chunk of a file, in which messages of several connections are packed together.

    Attributes
    ----------
    position, length
        Where it lies in the file, and how many bytes.
    held
        Connection -> the messages in the chunk, or what else says that there are any.
    start, end
        s since 1970 of the first and the last message; None where no index says so.
    compression, size
        How its data are packed, and their bytes when unpacked, where that is known beforehand.
    entries
        Its messages, where the chunk was walked; empty leaves them to its index.
    """

    position: int
    length: int
    held: Mapping[int, int]
    start: float | None = None
    end: float | None = None
    compression: str = ""
    size: int = 0
    entries: Entries = field(default_factory=dict)


@dataclass
class ChunkedFile(Container):
    """A container of chunks: read by its indexes, or walked from the front where they are lost."""

    _chunks: list[Chunk] = field(default_factory=list)

    @abstractmethod
    def _place(self, stream: BinaryIO, chunk: Chunk) -> tuple[str, int, int, int]:
        """Return how a chunk's records are packed, where they lie, and their two sizes."""

    @abstractmethod
    def _index(self, stream: BinaryIO, chunk: Chunk) -> Entries:
        """Return the messages of a chunk as the index behind it has them."""

    @abstractmethod
    def _scan(self, content: bytes) -> tuple[Mapping[int, list[tuple[int, int]]], int]:
        """Learn the connections in a chunk; return its messages, and how many bytes make sense."""

    @abstractmethod
    def _block(self, content: Bytes, number: int, time: Index, offset: Index) -> Block:
        """Find the payloads of a connection's messages, whose records begin at some offsets."""

    def _lost(self, chunks: Sequence[Chunk], wanted: Collection[int]) -> int | None:  # noqa: ARG002
        """Return how many wanted messages some chunks held, where that is known."""
        return None

    def blocks(self, wanted: Collection[int]) -> Iterator[tuple[int, Block]]:
        """Yield the messages of some connections, chunk by chunk."""
        lost: list[Chunk] = []
        with self.path.open("rb") as stream:
            for chunk in self._chunks:
                present = [number for number in wanted if number in chunk.held]
                try:
                    located = self._locate(stream, chunk, present) if present else []
                except DamagedError:
                    lost.append(chunk)
                    continue
                yield from located
        if lost:
            self.damage.append(
                Damage(
                    Cause.CHUNKS_DAMAGED,
                    lost=self._lost(lost, wanted),
                    bytes_lost=sum(chunk.length for chunk in lost),
                    occurrences=len(lost),
                    start=min((chunk.start for chunk in lost if chunk.start), default=None),
                    end=max((chunk.end for chunk in lost if chunk.end), default=None),
                )
            )

    def _locate(self, stream: BinaryIO, chunk: Chunk, wanted: list[int]) -> list[tuple[int, Block]]:
        """Return the blocks of a chunk, by the index behind it or by walking it."""
        try:
            entries = chunk.entries or self._index(stream, chunk)
        except DamagedError:
            entries = self._walked(stream, chunk)[0].entries
        compression, position, packed, _ = self._place(stream, chunk)
        if compression not in ("none", "") or packed < 4 * NEAR:
            content = self._content(stream, chunk)
        else:  # only the wanted pieces of one that may hold images unpacked
            content, entries = read_wanted(stream, position, packed, entries, wanted)
        return [(n, self._block(content, n, *entries[n])) for n in entries if n in wanted]

    def _content(self, stream: BinaryIO, chunk: Chunk) -> Bytes:
        """Return the unpacked records of a chunk."""
        compression, position, packed, size = self._place(stream, chunk)
        if packed > LARGEST_CHUNK:
            raise DamagedError(f"a chunk claims {packed} bytes")
        stream.seek(position)
        return np.frombuffer(unpack(compression, stream.read(packed), size), dtype=np.uint8)

    def _walked(self, stream: BinaryIO, chunk: Chunk) -> tuple[Chunk, int]:
        """Return a chunk with what walking it finds in it, and how many bytes make no sense."""
        content = self._content(stream, chunk).tobytes()
        rows, read = self._scan(content)
        entries = {number: _columns(held) for number, held in rows.items()}
        last = max((int(time.max()) for time, _ in entries.values()), default=None)
        known = replace(
            chunk,
            held={number: len(held) for number, held in rows.items()},
            end=None if last is None else last * 1e-9,
            entries=entries,
        )
        return known, len(content) - read

    def _add(self, stream: BinaryIO, chunk: Chunk) -> int:
        """Add a chunk that a walk came upon; return how many bytes of it make no sense."""
        missed = chunk.length
        with contextlib.suppress(DamagedError):
            chunk, missed = self._walked(stream, chunk)
        self._chunks.append(chunk)
        return missed if chunk.compression in ("none", "") else 0  # of the file, not unpacked

    def _salvaged(
        self, cause: Cause, lost: int, loose: Mapping[int, list[tuple[int, int, int]]]
    ) -> None:
        """Count what a walk found in chunks and outside, times first, and note the damage."""
        counts = Counter({number: len(rows) for number, rows in loose.items()})
        for chunk in self._chunks:
            counts.update(chunk.held)
        ends = [chunk.end for chunk in self._chunks if chunk.end is not None]
        ends += [max(rows)[0] * 1e-9 for rows in loose.values()]
        self._count(counts)
        salvaged, start = sum(counts.values()), max(ends, default=None)
        self.damage.append(Damage(cause, salvaged=salvaged, bytes_lost=lost, start=start))

    def _count(self, counts: Mapping[int, int]) -> None:
        """Tell the connections how many messages each has."""
        self.connections = {
            number: replace(known, count=counts.get(number, 0))
            for number, known in self.connections.items()
        }


def _columns(rows: list[tuple[int, int]]) -> tuple[Index, Index]:
    table = np.array(rows, dtype=np.int64)
    return table[:, 0], table[:, 1]


def read_wanted(
    stream: BinaryIO, origin: int, size: int, entries: Entries, wanted: Collection[int]
) -> tuple[Bytes, Entries]:
    """Read the wanted connections' records of an unpacked chunk.

    Parameters
    ----------
    stream, origin, size
        As of `read_pieces`.
    entries
        Of the chunk.
    wanted
        Connections among them.

    Returns
    -------
    tuple
        The bytes read, and the wanted entries with their offsets in them.
    """
    kept = {number: entry for number, entry in entries.items() if number in wanted}
    if not kept:
        raise DamagedError("an index points nowhere")
    bounds = np.unique(np.concatenate([offset for _, offset in entries.values()]))
    starts = np.unique(np.concatenate([offset for _, offset in kept.values()]))
    content, moved = read_pieces(stream, origin, size, starts, bounds)
    return content, {
        number: (time, moved[np.searchsorted(starts, offset)])
        for number, (time, offset) in kept.items()
    }


def read_pieces(
    stream: BinaryIO, origin: int, size: int, starts: Index, bounds: Index
) -> tuple[Bytes, Index]:
    """Read the wanted records of an unpacked chunk, and not the images between them.

    Parameters
    ----------
    stream
        The file.
    origin, size
        Where the chunk's data begin in it, and how long they are.
    starts
        (n,) increasing offsets of wanted records in the chunk.
    bounds
        Increasing offsets of all records.

    Returns
    -------
    tuple
        The bytes read, and (n,) where each wanted record begins in them.
    """
    if len(starts) == 0 or starts[0] < 0 or starts[-1] >= size:
        raise DamagedError("an index points nowhere")
    bounds = np.append(bounds[bounds < size], size)
    ends = bounds[np.searchsorted(bounds, starts, side="right")]
    apart = np.flatnonzero(starts[1:] - ends[:-1] > NEAR) + 1
    first = np.concatenate([[0], apart])
    last = np.concatenate([apart, [len(starts)]]) - 1
    pieces = []
    moved = np.empty_like(starts)
    length = 0
    for begin, end in zip(first, last, strict=True):
        stream.seek(origin + int(starts[begin]))
        piece = stream.read(int(ends[end] - starts[begin]))
        moved[begin : end + 1] = starts[begin : end + 1] - starts[begin] + length
        pieces.append(piece)
        length += len(piece)
        if length > LARGEST_CHUNK:
            raise DamagedError("a chunk is absurdly long")
    return np.frombuffer(b"".join(pieces), dtype=np.uint8), moved

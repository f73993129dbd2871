"""A ROS recording in any container, or a folder of them."""

from __future__ import annotations

import contextlib
import re
import shutil
import weakref
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tuner.core.disk import file_name
from tuner.core.errors import ConfigError, RecordingError
from tuner.core.yaml_section import read_yaml
from tuner.recordings import ulog
from tuner.recordings.notes import Cause, Damage
from tuner.recordings.recording import (
    NS_PER_SECOND,
    Clock,
    FieldLayout,
    Nanoseconds,
    ReadResult,
    Recording,
    Topic,
    TopicSamples,
)
from tuner.recordings.ros.bag1 import Bag1
from tuner.recordings.ros.container import (
    MAX_CHUNK_BYTES,
    Connection,
    Container,
    DamagedError,
    block_of,
    unpack,
    zstd,
)
from tuner.recordings.ros.db3 import Db3
from tuner.recordings.ros.mcap import Mcap
from tuner.recordings.ros.messages import (
    FIELD_LAYOUTS,
    Definitions,
    Fields,
    MessageBlock,
    decode,
    missing_fields,
)

#: A file compressed as a whole is unpacked to at most so many times its size, or to so many bytes
#: if it is small: flights need no more.
MAX_UNPACK_RATIO, MIN_UNPACK_LIMIT = 100, 1 << 30


@dataclass
class Folder(Container):
    """A folder with one or more ``.db3`` or ``.mcap`` files."""

    _files: list[Container] = field(default_factory=list)
    _numbers: dict[int, tuple[int, int]] = field(default_factory=dict)
    _compressed: bool = False
    _unpacked: Path | None = None

    def __post_init__(self) -> None:
        names, mode = self._metadata()
        self._compressed = mode == "message"
        errors = []
        for name in names:
            path = self.path / Path(name).name
            try:
                self._files.append(
                    open_data_file(self._unpack(path) if path.suffix == ".zstd" else path)
                )
            except (RecordingError, DamagedError, OSError) as err:
                errors.append(str(err))
                size = path.stat().st_size if path.is_file() else None
                self.damage.append(Damage(Cause.FILE_UNREADABLE, path.name, bytes_lost=size))
        if not self._files:
            reason = errors[0] if errors else "holds no .db3 or .mcap file"
            raise RecordingError(self.path, reason, "give the folder with metadata.yaml")
        for i, container in enumerate(self._files):
            self.damage += container.damage
            for connection in container.connections.values():
                number = len(self._numbers)
                self._numbers[number] = (i, connection.id)
                self.connections[number] = replace(connection, id=number)
        known = {c.type: c.definition for c in self.connections.values() if c.definition.data}
        self.connections = {  # of a connection without a definition, that of its type elsewhere
            number: replace(c, definition=known.get(c.type, c.definition))
            for number, c in self.connections.items()
        }

    def blocks(self, wanted: Collection[int]) -> Iterator[tuple[int, MessageBlock]]:
        """Yield the messages of some connections, file by file."""
        for i, container in enumerate(self._files):
            here = {inner: n for n, (file, inner) in self._numbers.items() if file == i}
            inside = [inner for inner, number in here.items() if number in wanted]
            known = len(container.damage)
            for inner, block in container.blocks(inside):
                yield here[inner], unpacked_block(block) if self._compressed else block
            self.damage += container.damage[known:]

    def _metadata(self) -> tuple[list[str], str]:
        """Return the files and the compression mode, from the metadata or else the folder."""
        path = self.path / "metadata.yaml"
        try:
            about: Any = read_yaml(path).data
            about = about["rosbag2_bagfile_information"]
            names, mode = about["relative_file_paths"], about.get("compression_mode") or ""
            if names and all(isinstance(name, str) for name in (*names, mode)):
                return list(dict.fromkeys(names)), mode.lower()
            raise ValueError("it names no file")
        except (ConfigError, ValueError, KeyError, TypeError, AttributeError):
            names = sorted(
                file.name
                for file in self.path.iterdir()
                if file.suffix in (".db3", ".mcap") or file.name.endswith(".db3.zstd")
            )
            self.damage.append(Damage(Cause.METADATA_MISSING, path.name))
            return names, ""

    def _unpack(self, path: Path) -> Path:
        """Unpack a file that was compressed as a whole."""
        if not path.is_file():  # a pipe is never read
            raise DamagedError(f"{path.name} is no file")
        if self._unpacked is None:
            self._unpacked = Path(mkdtemp(prefix="tune-"))
            weakref.finalize(self, shutil.rmtree, self._unpacked, True)
        target = self._unpacked / file_name(path.stem)
        room = max(MIN_UNPACK_LIMIT, MAX_UNPACK_RATIO * path.stat().st_size)
        try:
            with zstd().open(path, "rb") as packed, target.open("wb") as stream:
                while part := packed.read(1 << 20):
                    room -= len(part)
                    if room < 0:
                        raise DamagedError(f"{path.name} unpacks to an absurd size")
                    stream.write(part)
        except (zstd().ZstdError, EOFError) as err:
            raise DamagedError(f"{path.name} cannot be unpacked ({err})") from None
        return target


def unpacked_block(block: MessageBlock) -> MessageBlock:
    """Unpack messages that were compressed one by one, up to `MAX_CHUNK_BYTES` bytes.

    A damaged one becomes empty.
    """
    payloads, room = [], MAX_CHUNK_BYTES
    for start, end in zip(block.start, block.end, strict=True):
        try:
            payloads.append(unpack("zstd", block.buffer[start:end].tobytes(), room))
        except DamagedError:
            payloads.append(b"")
        room -= len(payloads[-1])
    return block_of(block.time.tolist(), payloads)


def open_data_file(path: Path) -> Container:
    """Open one data file of a ROS 2 recording by its first bytes."""
    if not path.is_file():
        raise DamagedError(f"{path.name} is no file")
    with path.open("rb") as stream:
        magic = stream.read(16)
    return Db3(path) if magic.startswith(b"SQLite format 3") else Mcap(path)


_SECONDS, _NANOSECONDS = "header.stamp.sec", "header.stamp.nanosec"


def open_container(path: Path) -> Container:
    """Open the container of a ROS recording by its first bytes."""
    if path.is_dir():
        return Folder(path)
    with path.open("rb") as stream:
        magic = stream.read(7)
    return Bag1(path) if magic in (b"#ROSBAG", b"") else open_data_file(path)


class RosRecording(Recording):
    """Topics of a ROS container.

    Parameters
    ----------
    messages
        ``.msg`` files for types that the container does not define.
    """

    format = "ros"

    def __init__(self, path: Path, messages: tuple[Path, ...] = ()) -> None:
        self.path = path
        self._container = container = open_container(path)
        texts = {c.type: c.definition for c in container.connections.values()}
        self._definitions = Definitions(path, texts, messages, standard=container.aligned)
        counts: Counter[tuple[str, str]] = Counter()
        for connection in container.connections.values():
            counts[connection.topic, connection.type] += connection.count
        self.topics = tuple(
            Topic(name, kind, count) for (name, kind), count in sorted(counts.items())
        )

    def field_layout(self, topic: str, signal: str) -> FieldLayout | None:
        """Return the fields that hold a signal in messages of this topic's type."""
        kind = self._kind(topic)
        if kind.startswith("px4_msgs/"):
            in_log = re.sub(r"(?<!^)(?=[A-Z])", "_", kind.rpartition("/")[2]).lower()
            return ulog.FIELD_LAYOUTS.get(in_log, {}).get(signal)
        return FIELD_LAYOUTS.get(kind, {}).get(signal)

    def fields(self, topic: str) -> list[str]:
        """Return the names of the fields of a topic's messages."""
        return [name for name, _ in self._type(topic) or ()]

    def missing_fields(self, topic: str, fields: tuple[str, ...]) -> tuple[str, ...]:
        """Return the fields that a topic's messages do not have."""
        try:
            return missing_fields(self._definitions, self._kind(topic), fields)
        except RecordingError:
            return fields

    def is_defined(self, topic: str) -> bool:
        """Return whether the definition of a topic's message type is known."""
        return self._type(topic) is not None

    def _type(self, topic: str) -> Fields | None:
        with contextlib.suppress(RecordingError):
            return self._definitions.fields(self._kind(topic))
        return None

    def _kind(self, topic: str) -> str:
        return next((known.type for known in self.topics if known.name == topic), "")

    def read(
        self, wanted: Mapping[str, tuple[str, ...]], clocks: tuple[Clock, ...] = ()
    ) -> ReadResult:
        """Read the wanted fields of some topics."""
        plans: dict[int, tuple[list[str], Clock | None]] = {}
        for connection in self._container.connections.values():
            if connection.topic in wanted and connection.count:
                plans[connection.id] = self._plan(connection, wanted[connection.topic], clocks)
        parts: dict[str, list[TopicSamples]] = {name: [] for name in wanted}
        broken: dict[str, int] = dict.fromkeys(wanted, 0)
        for number, block in self._container.blocks(plans):
            (fields, clock), source = plans[number], self._container.connections[number]
            columns, whole = decode(
                self._definitions, source.type, fields, block, aligned=self._container.aligned
            )
            broken[source.topic] += int(len(whole) - whole.sum())
            parts[source.topic].append(_samples(columns, whole, block.time, clock))
        cut = [
            Damage(Cause.MESSAGES_DAMAGED, topic, lost=count)
            for topic, count in broken.items()
            if count
        ]
        samples = {name: _joined(rows) for name, rows in parts.items() if rows}
        return ReadResult(samples, damage=(*self._container.damage, *cut))

    def _plan(
        self, connection: Connection, wanted: Sequence[str], clocks: Sequence[Clock]
    ) -> tuple[list[str], Clock | None]:
        """Return the fields to read, with those of the time, and the clock (None: the header)."""
        kind, fields, known = connection.type, list(wanted), self._definitions
        clock = next((c for c in clocks if not missing_fields(known, kind, (c.field,))), None)
        if clock is not None:
            fields.append(clock.field)
        elif not missing_fields(known, kind, (_SECONDS,)):
            fields += [_SECONDS, _NANOSECONDS]
        if missing := missing_fields(known, kind, fields):
            what = f"{connection.topic}: {kind} has no field '{min(missing)}'"
            raise RecordingError(self.path, what, "correct the topic map")
        return fields, clock


def _samples(
    columns: dict[str, NDArray[Any]],
    whole: NDArray[np.bool_],
    receive: Nanoseconds,
    clock: Clock | None,
) -> TopicSamples:
    kept = {name: values[whole] for name, values in columns.items()}
    stamp = None
    if clock is not None:
        stamp = kept.pop(clock.field).astype(np.int64) * clock.nanoseconds
    elif _SECONDS in kept:
        seconds = kept.pop(_SECONDS).astype(np.int64)
        stamp = seconds * NS_PER_SECOND + kept.pop(_NANOSECONDS).astype(np.int64)
    return TopicSamples(
        receive[whole], stamp, {name: values.astype(np.float64) for name, values in kept.items()}
    )


def _joined(parts: list[TopicSamples]) -> TopicSamples:
    stamps = [part.stamp for part in parts if part.stamp is not None]
    return TopicSamples(
        np.concatenate([part.receive for part in parts]),
        np.concatenate(stamps) if len(stamps) == len(parts) else None,
        {name: np.concatenate([part.fields[name] for part in parts]) for name in parts[0].fields},
    )

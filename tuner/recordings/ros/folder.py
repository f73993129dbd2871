"""A ROS 2 recording as a folder: ``metadata.yaml`` and the files that it names."""

from __future__ import annotations

import shutil
import weakref
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

from tuner.core.disk import file_name
from tuner.core.errors import ConfigError, RecordingError
from tuner.core.yaml_document import read_yaml
from tuner.recordings.notes import Cause, Damage
from tuner.recordings.ros.container import (
    LARGEST_CHUNK,
    Connection,
    Container,
    DamagedError,
    joined,
    unpack,
    zstd,
)
from tuner.recordings.ros.db3 import Db3
from tuner.recordings.ros.mcap import Mcap
from tuner.recordings.ros.wire import Block

#: Files compressed as a whole are unpacked beside the others up to this size.
LARGEST_UNPACKED = 32 << 30


@dataclass
class Folder:
    """A folder with one or more ``.db3`` or ``.mcap`` files.

    Raises
    ------
    RecordingError
        No file in it can be read.
    """

    path: Path
    aligned: bool = True
    connections: dict[int, Connection] = field(default_factory=dict)
    _left_out: list[Damage] = field(default_factory=list)
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
                    open_file(self._unpack(path) if path.suffix == ".zstd" else path)
                )
            except (RecordingError, DamagedError, OSError) as err:
                errors.append(str(err))
                size = path.stat().st_size if path.is_file() else None
                self._left_out.append(Damage(Cause.FILE_UNREADABLE, path.name, bytes_lost=size))
        if not self._files:
            reason = errors[0] if errors else "holds no .db3 or .mcap file"
            raise RecordingError(self.path, reason, "give the folder with metadata.yaml")
        for i, container in enumerate(self._files):
            for connection in container.connections.values():
                number = len(self._numbers)
                self._numbers[number] = (i, connection.id)
                self.connections[number] = replace(connection, id=number)
        self._share_definitions()

    @property
    def damage(self) -> list[Damage]:
        """What could not be read so far, of the folder and its files."""
        return [*self._left_out, *(damage for file in self._files for damage in file.damage)]

    def blocks(self, wanted: Collection[int]) -> Iterator[tuple[int, Block]]:
        """Yield the messages of some connections, file by file."""
        for i, container in enumerate(self._files):
            here = {inner: n for n, (file, inner) in self._numbers.items() if file == i}
            inside = [inner for inner, number in here.items() if number in wanted]
            for inner, block in container.blocks(inside):
                yield here[inner], self._unpacked_block(block) if self._compressed else block

    def _metadata(self) -> tuple[list[str], str]:
        """Return the files and the compression mode, from the metadata or from what lies there."""
        path = self.path / "metadata.yaml"
        try:
            about: Any = read_yaml(path).data
            about = about["rosbag2_bagfile_information"]
            names, mode = about["relative_file_paths"], about.get("compression_mode") or ""
            if names and all(isinstance(name, str) for name in (*names, mode)):
                return names, mode.lower()
            raise ValueError("it names no file")
        except (ConfigError, ValueError, KeyError, TypeError, AttributeError):
            names = sorted(
                file.name
                for file in self.path.iterdir()
                if file.suffix in (".db3", ".mcap") or file.name.endswith(".db3.zstd")
            )
            self._left_out.append(Damage(Cause.METADATA_MISSING, path.name))
            return names, ""

    def _unpack(self, path: Path) -> Path:
        """Unpack a file that was compressed as a whole."""
        if self._unpacked is None:
            self._unpacked = Path(mkdtemp(prefix="tune-"))
            weakref.finalize(self, shutil.rmtree, self._unpacked, True)
        target = self._unpacked / file_name(path.stem)
        written = 0
        try:
            with zstd().open(path, "rb") as packed, target.open("wb") as stream:
                while part := packed.read(1 << 20):
                    written += len(part)
                    if written > LARGEST_UNPACKED:
                        raise DamagedError(f"{path.name} unpacks to an absurd size")
                    stream.write(part)
        except (zstd().ZstdError, EOFError) as err:
            raise DamagedError(f"{path.name} cannot be unpacked ({err})") from None
        return target

    def _unpacked_block(self, block: Block) -> Block:
        """Unpack messages that were compressed one by one; a damaged one becomes empty."""
        payloads = []
        for start, end in zip(block.start, block.end, strict=True):
            try:
                packed = block.buffer[start:end].tobytes()
                payloads.append(unpack("zstd", packed, LARGEST_CHUNK))
            except DamagedError:
                payloads.append(b"")
        return joined(block.time.tolist(), payloads)

    def _share_definitions(self) -> None:
        """Give connections without a definition the one that another file has of their type."""
        known = {c.type: c.definition for c in self.connections.values() if c.definition.data}
        self.connections = {
            number: replace(c, definition=known.get(c.type, c.definition))
            for number, c in self.connections.items()
        }


def open_file(path: Path) -> Container:
    """Open one data file of a ROS 2 recording by what it begins with."""
    with path.open("rb") as stream:
        magic = stream.read(16)
    return Db3(path) if magic.startswith(b"SQLite format 3") else Mcap(path)

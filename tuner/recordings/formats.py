"""The formats of recordings: a reader each, which knows its files by how they begin.

A format needs two things: a reader here, and a topic map whose ``format`` names it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from tuner.core.disk import readable
from tuner.core.errors import RecordingError
from tuner.recordings.layout import is_table
from tuner.recordings.recording import Recording

NO_TEXTS = (".bag", ".db3", ".mcap", ".ulg")
"""Suffixes of recordings that no text has."""


@dataclass(frozen=True)
class Head:
    """What a recording shows before it is opened.

    Attributes
    ----------
    path
        The file or folder.
    start
        The first 4096 bytes; none of a folder.
    """

    path: Path
    start: bytes


@dataclass(frozen=True)
class Reader:
    """One format.

    Attributes
    ----------
    format
        What the ``format`` of a topic map is compared with.
    files
        Its files, as the message that refuses an unknown format lists them.
    matches
        Says whether a recording is of this format.
    open
        Opens a recording, given ``.msg`` files for types that it does not define. It imports what
        the format needs: together the formats' libraries take half a second.
    tabular
        Whether a recording is one table whose columns are named by the topic map alone.
    """

    format: str
    files: str
    matches: Callable[[Head], bool]
    open: Callable[[Path, tuple[Path, ...]], Recording]
    tabular: bool = False


def _is_ros(head: Head) -> bool:
    empty_bag = head.path.suffix == ".bag" and not head.start
    magic = (b"#ROSBAG", b"\x89MCAP", b"SQLite format 3")
    return head.path.is_dir() or head.start.startswith(magic) or empty_bag


def _is_table(head: Head) -> bool:
    """Return whether a file is Parquet, or a text with cells that is not called a bag or a log."""
    text = head.path.suffix.lower() not in NO_TEXTS and is_table(head.start)
    return head.start.startswith(b"PAR1") or text


def _in(module: str, name: str) -> Callable[[Path, tuple[Path, ...]], Recording]:
    """Return what opens a recording with a reader of a module that is then imported."""

    def opened(path: Path, messages: tuple[Path, ...]) -> Recording:
        reader = getattr(import_module(f"tuner.recordings.{module}"), name)
        recording: Recording = reader(path, messages) if module.startswith("ros") else reader(path)
        return recording

    return opened


READERS: tuple[Reader, ...] = (
    Reader(
        "ros",
        "ROS 1 .bag, ROS 2 folders, .db3 and .mcap",
        _is_ros,
        _in("ros.recording", "RosRecording"),
    ),
    Reader(
        "ulog",
        "PX4 .ulg",
        lambda head: head.start.startswith(b"ULog"),
        _in("ulog", "ULogRecording"),
    ),
    Reader(
        "micro_sd",
        "Crazyflie micro-SD logs",  # a byte 0xBC alone is that of any text
        lambda head: head.start.startswith((b"\xbc\x01\x00", b"\xbc\x02\x00")),
        _in("micro_sd", "MicroSdRecording"),
    ),
    Reader(
        "table",
        "MATLAB .mat",
        lambda head: head.start.startswith((b"MATLAB 5.0 MAT-file", b"MATLAB 7.3 MAT-file")),
        _in("matlab", "MatlabTable"),
        tabular=True,
    ),
    Reader("table", ".csv and .parquet", _is_table, _in("table", "Table"), tabular=True),
)
"""The first that matches reads a recording."""


def is_tabular(name: object) -> bool:
    """Return whether recordings of a format are tables; an unknown format's are not."""
    return any(reader.format == name and reader.tabular for reader in READERS)


def open_recording(path: Path, messages: tuple[Path, ...] = ()) -> Recording:
    """Open a recording with the reader of what it begins with, whatever its name says.

    Parameters
    ----------
    path
        A file, or a folder as ROS 2 writes it.
    messages
        ``.msg`` files, or folders of them, for ROS types that the recording does not define.

    Raises
    ------
    RecordingError
        It is missing, unreadable or of no known format.
    """
    start = b""
    with readable(path):
        if not path.is_dir():
            with path.open("rb") as stream:
                start = stream.read(4096)
        head = Head(path, start)
        for reader in READERS:
            if reader.matches(head):
                return reader.open(path, messages)
    if start.startswith((b"\x1f\x8b", b"PK\x03\x04", b"BZh", b"\xfd7zXZ")):
        raise RecordingError(path, "is packed", "unpack it first")
    known = "; ".join(reader.files for reader in READERS)
    what = "is of no known format" if start else "is empty"
    if path.suffix.lower() in NO_TEXTS and is_table(start):
        what = f"is a text, and no {path.suffix}"
    raise RecordingError(path, what, f"known formats are {known}")

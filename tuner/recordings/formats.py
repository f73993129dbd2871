"""The formats of recordings: one reader each, which recognises its files by their first bytes.

A format needs a reader here, and a topic map whose ``format`` names it. The first lines of a text
table show its layout: encoding, separator, comments, columns and their units.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from tuner.core.disk import readable
from tuner.core.errors import RecordingError
from tuner.recordings.recording import Recording


@dataclass(frozen=True)
class Reader:
    """One format.

    Attributes
    ----------
    format
        Its name in the ``format`` of a topic map.
    files
        Its files, as the error for an unknown format lists them.
    matches
        Whether a recording is of this format, by its path and its first 4096 bytes; those of a
        folder are empty.
    open
        Opens a recording, given ``.msg`` files for types that it does not define. It imports the
        format's library on demand: all of them together take half a second.
    suffixes
        Those by which its files are known; a table of text has none of another format's.
    tabular
        Whether a recording is one table whose columns are named by the topic map alone.
    """

    format: str
    files: str
    matches: Callable[[Path, bytes], bool]
    open: Callable[[Path, tuple[Path, ...]], Recording]
    suffixes: tuple[str, ...] = ()
    tabular: bool = False


def _is_ros(path: Path, start: bytes) -> bool:
    empty_bag = path.suffix == ".bag" and not start
    return (
        path.is_dir()
        or start.startswith((b"#ROSBAG", b"\x89MCAP", b"SQLite format 3"))
        or empty_bag
    )


def _is_table(path: Path, start: bytes) -> bool:
    """Return whether a file is Parquet, or a text with cells that is not called a bag or a log."""
    return start.startswith(b"PAR1") or (not _is_called_binary(path) and is_table(start))


def _is_called_binary(path: Path) -> bool:
    return any(path.suffix.lower() in r.suffixes for r in READERS if not r.tabular)


def _lazy_reader(module: str, name: str) -> Callable[[Path, tuple[Path, ...]], Recording]:
    """Return a function that imports a reader and opens a recording with it."""

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
        _lazy_reader("ros.recording", "RosRecording"),
        (".bag", ".db3", ".mcap"),
    ),
    Reader(
        "ulog",
        "PX4 .ulg",
        lambda _, start: start.startswith(b"ULog"),
        _lazy_reader("ulog", "ULogRecording"),
        (".ulg",),
    ),
    Reader(
        "micro_sd",
        "Crazyflie micro-SD logs",  # a byte 0xBC alone is that of any text
        lambda _, start: start.startswith((b"\xbc\x01\x00", b"\xbc\x02\x00")),
        _lazy_reader("micro_sd", "MicroSdRecording"),
    ),
    Reader(
        "table",
        "MATLAB .mat",
        lambda _, start: start.startswith((b"MATLAB 5.0 MAT-file", b"MATLAB 7.3 MAT-file")),
        _lazy_reader("matlab", "MatlabRecording"),
        (".mat",),
        tabular=True,
    ),
    Reader(
        "table",
        ".csv and .parquet",
        _is_table,
        _lazy_reader("table", "TableRecording"),
        (".csv", ".tsv", ".parquet"),
        tabular=True,
    ),
)
"""The first that matches reads the recording."""


def is_tabular(name: object) -> bool:
    """Return whether recordings of a format are tables; an unknown format's are not."""
    return any(reader.format == name and reader.tabular for reader in READERS)


def open_recording(path: Path, messages: tuple[Path, ...] = ()) -> Recording:
    """Open a recording with the reader for its first bytes, whatever its suffix.

    Parameters
    ----------
    path
        A file, or a folder of ROS 2.
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
        for reader in READERS:
            if reader.matches(path, start):
                return reader.open(path, messages)
    if start.startswith((b"\x1f\x8b", b"PK\x03\x04", b"BZh", b"\xfd7zXZ")):
        raise RecordingError(path, "is packed", "unpack it first")
    known = "; ".join(reader.files for reader in READERS)
    what = "is of no known format" if start else "is empty"
    if _is_called_binary(path) and is_table(start):
        what = f"is a text, and no {path.suffix}"
    raise RecordingError(path, what, f"known formats are {known}")


#: A longer line is no row of a table.
MAX_LINE_BYTES = 1 << 20
MAX_PREAMBLE_LINES = 1000
#: Byte order marks and their encodings.
BOMS = {b"\xef\xbb\xbf": "utf-8-sig", b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16"}
COMMENT_MARKS = ("#", "%", "//", "sep=")
#: A table's rows begin within so many bytes and lines.
MAX_PREAMBLE_BYTES = 4 * MAX_LINE_BYTES
_NUMBER = re.compile(r"^[+-]?(\d+[.,]?\d*|[.,]\d+)([eE][+-]?\d+)?$|^[+-]?(nan|inf(inity)?)$", re.I)
_UNIT = re.compile(r"^[\[(]?[a-zA-Zµ°%0-9/^*.·\-²³ ]{0,12}[\])]?$")


@dataclass(frozen=True)
class Layout:
    """The layout of a text table.

    Attributes
    ----------
    decimal_comma
        Whether numbers are written as ``1,5``.
    columns
        Their unique names, without surrounding blanks.
    units
        Column -> unit, from a row of units under the names.
    lines_before
        The number of lines before the first row of numbers.
    """

    encoding: str
    separator: str
    decimal_comma: bool
    columns: tuple[str, ...]
    units: Mapping[str, str]
    lines_before: int


def encoding_of(start: bytes) -> str:
    """Return the codec of a text by its byte order mark; latin-1, which reads all, without one."""
    return next((codec for mark, codec in BOMS.items() if start.startswith(mark)), "latin-1")


def text_of(start: bytes) -> str:
    """Return the text that a file begins with."""
    encoding = encoding_of(start)
    return start.decode("utf-8" if encoding == "latin-1" else encoding, errors="replace")


def is_table(start: bytes) -> bool:
    """Return whether a file is a text whose first line that is no comment has cells."""
    wide = encoding_of(start).startswith("utf-16")
    text = text_of(start)
    if not all(ord(letter) >= 32 or letter in "\r\n\t" for letter in text):
        return False
    if not wide and not all(byte >= 32 or byte in b"\r\n\t" for byte in start):
        return False
    lines = text.splitlines()[:MAX_PREAMBLE_LINES]
    first = next((i for i, line in enumerate(lines) if not _is_comment(line)), 0)
    line = lines[first] if lines else ""
    behind = lines[first + 1] if first + 1 < len(lines) else line
    separator = _separator(line)
    return separator != " " or (len(_cells(line, " ")) > 3 and _is_row(behind, " "))


def layout_of(path: Path) -> Layout:
    """Return the layout of a text table.

    Raises
    ------
    RecordingError
        It has no line of column names.
    """
    with path.open("rb") as stream:
        head = stream.read(MAX_PREAMBLE_BYTES)
    encoding = encoding_of(head)
    lines = text_of(head).splitlines()[:MAX_PREAMBLE_LINES]
    place = next((i for i, line in enumerate(lines) if not _is_comment(line)), len(lines) - 1)
    separator = _separator(lines[place] if lines else "")
    names = place
    if names and _is_row(lines[place], separator) and _is_header(lines[place - 1], separator):
        names -= 1  # the names stand in the last comment
        place -= 1
    elif lines and _is_row(lines[place], separator):
        raise RecordingError(
            path,
            "has no line of column names: it begins with numbers",
            "write the names of its columns into the first line",
        )
    columns = _cells(lines[names].lstrip("#/ ") if lines else "", separator)
    place = names + 1
    units: dict[str, str] = {}
    if place + 1 < len(lines) and _is_units(lines[place], separator, len(columns)):
        units = dict(zip(columns, _cells(lines[place], separator), strict=False))
        place += 1
    first = lines[place] if place < len(lines) else ""
    cells = _cells(first, separator)
    if len(cells) == len(columns) - 1 and not columns[-1]:
        columns = columns[:-1]
    if len(cells) == len(columns) + 1:  # every row ends with a separator, or begins with its name
        columns = ["", *columns] if cells[-1] else [*columns, ""]
    rows = [row for row in lines[place : place + 20] if row]
    comma = separator != "," and any(re.search(r"\d,\d", row) for row in rows)
    return Layout(encoding, separator, comma, _unique_names(columns), units, place)


def _is_comment(line: str) -> bool:
    text = line.strip().lstrip("\ufeff")
    return not text or (text.startswith(COMMENT_MARKS) and not text.startswith("%time"))


def _separator(line: str) -> str:
    """Return the separator of a line's cells."""
    best = max(",;\t", key=line.count)
    return best if best in line else " "


def _cells(line: str, separator: str) -> list[str]:
    text = line.strip("\r\n").lstrip("\ufeff")
    if separator == " " or len(text) > csv.field_size_limit():
        return text.split(None if separator == " " else separator)
    return [cell.strip().strip('"') for cell in next(csv.reader([text], delimiter=separator), [])]


def _is_row(line: str, separator: str) -> bool:
    """Return whether a line holds numbers and no names."""
    cells = [cell for cell in _cells(line, separator) if cell]
    numbers = sum(bool(_NUMBER.match(cell)) for cell in cells)
    return numbers > len(cells) / 2


def _is_header(line: str, separator: str) -> bool:
    cells = _cells(line.lstrip("#%/ "), separator)
    return len(cells) > 1 and not any(_NUMBER.match(cell) for cell in cells)


def _is_units(line: str, separator: str, count: int) -> bool:
    """Return whether a line under the names holds units."""
    cells = _cells(line, separator)
    if not count - 1 <= len(cells) <= count or any(_NUMBER.match(cell) for cell in cells):
        return False
    return any(cells) and all(_UNIT.match(cell) for cell in cells)


def _unique_names(columns: Sequence[str]) -> tuple[str, ...]:
    """Return unique names: empty ones become their place, repeated ones get a number."""
    seen: dict[str, int] = {}
    names = []
    for place, column in enumerate(columns):
        name = column or f"column {place + 1}"
        seen[name] = seen.get(name, 0) + 1
        names.append(name if seen[name] == 1 else f"{name} ({seen[name]})")
    return tuple(names)

"""MATLAB files: arrays, and structures of arrays, as the columns of a table.

``mocap.t``, ``mocap.pos`` (n x 3) and ``imu.t``, ``imu.gyro`` become the columns ``mocap.pos[0]``
and so on, each with the time of its own structure: the table has a row for every stamp of each.
scipy reads files up to version 7, h5py those of version 7.3.
"""

from __future__ import annotations

import contextlib
import io
import subprocess
import sys
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow

from tuner.core.errors import RecordingError, short_reason
from tuner.core.numerics import Array
from tuner.recordings import matlab_columns
from tuner.recordings.matlab_columns import MAX_DEPTH, Described, described
from tuner.recordings.notes import Note
from tuner.recordings.recording import (
    TABLE_TOPIC,
    Clock,
    ReadResult,
    TabularRecording,
    TopicSamples,
)
from tuner.recordings.sources import column_meaning
from tuner.recordings.table import NO_TIME, read_times

MAGIC, MAGIC_7_3 = b"MATLAB 5.0 MAT-file", b"MATLAB 7.3 MAT-file"
#: All arrays together have no more bytes, and are no more: scipy recurses into nested ones.
MAX_BYTES, MAX_ARRAYS = 1 << 30, 4000
#: The column that stands for the time of each structure, if several have their own.
ANY_TIME = "*.time"


class MatlabRecording(TabularRecording):
    """Arrays of one or several structures.

    Raises
    ------
    RecordingError
        It is no readable file, or holds no columns.
    """

    def __init__(self, path: Path) -> None:
        with path.open("rb") as stream:
            newer = stream.read(len(MAGIC_7_3)) == MAGIC_7_3
        self._columns, whole = described(_load_hdf5(path)) if newer else _load(path)
        if not self._columns:
            raise RecordingError(
                path,
                "holds no numeric columns (timeseries and tables are objects, which only MATLAB "
                "reads)",
                "save arrays, or a structure of arrays",
            )
        self._times = {name: _time_of(name, self._columns) for name in self._columns}
        clocks = {time for time in self._times.values() if time is not None}
        columns = [*([ANY_TIME] if len(clocks) > 1 else []), *self._columns]
        super().__init__(path, "table", columns)
        if len(whole) == 1 and len(self._columns) > 1 and not clocks:
            name, count = whole[0], len(self._columns)
            remedy = (
                f"name them in a topic map (--topics FILE): time: '{name}[0]', and under signals "
                f"position: ['{name}[1]', '{name}[2]', '{name}[3]'], and so on"
            )
            what = f"holds the bare matrix '{name}' of {count} columns, which have no names"
            self.naming_problem = (what, remedy)

    def read(
        self, wanted: Mapping[str, tuple[str, ...]], clocks: tuple[Clock, ...] = ()
    ) -> ReadResult:
        """Read the wanted columns, each at the times of its own structure."""
        if TABLE_TOPIC not in wanted:
            return ReadResult({})
        clock, wanted_columns = self.clock(clocks), wanted[TABLE_TOPIC]
        groups: dict[str, list[str]] = {}
        for name in wanted_columns:
            time = self._times.get(name) if clock.field == ANY_TIME else clock.field
            if time is not None and len(self._columns[time]) == len(self._columns[name]):
                groups.setdefault(time, []).append(name)
        parts, notes = [], list[Note]()
        for field, names in groups.items():
            part, note = self._part(Clock(field=field, unit=clock.unit), names, wanted_columns)
            parts.append(part)
            notes += note
        if not parts:
            raise RecordingError(
                self.path, f"has no column as long as '{clock.field}'", "name another time"
            )
        stamps = np.concatenate([part.receive for part in parts])
        fields = {n: np.concatenate([part.fields[n] for part in parts]) for n in wanted_columns}
        return ReadResult({TABLE_TOPIC: TopicSamples(stamps, stamps, fields)}, tuple(notes))

    def _part(
        self, clock: Clock, names: list[str], fields: tuple[str, ...]
    ) -> tuple[TopicSamples, tuple[Note, ...]]:
        """Return the rows of one structure, NaN in the columns of the others."""
        stamps = self._columns[clock.field]
        column = pyarrow.chunked_array([pyarrow.array(stamps)])
        held = {name: self._columns[name] for name in names}
        time, notes = read_times(self.path, column, clock, held.values())
        known, nothing = time != NO_TIME, np.full(len(time), np.nan)
        values = {name: held.get(name, nothing)[known] for name in fields}
        return TopicSamples(time[known], time[known], values), notes


def _load(path: Path) -> Described:
    """Read a file of version 5 to 7, in a process of its own: scipy may crash on a hostile one."""
    data = path.read_bytes() if path.stat().st_size <= MAX_BYTES else b""
    size, arrays = 0 if data else MAX_BYTES + 1, 0
    for piece in _decompressed(data):
        size += len(piece)
        arrays += piece.count(b"\x0e\0\0\0") + piece.count(b"\0\0\0\x0e")  # at least
        if size > MAX_BYTES:
            break
    if size > MAX_BYTES:
        raise RecordingError(path, "is larger than any recording of a flight", "cut it")
    if arrays > MAX_ARRAYS:
        raise RecordingError(
            path, f"holds more than {MAX_ARRAYS} arrays", "save each signal as one array"
        )
    command = [sys.executable, "-P", "-m", matlab_columns.__name__]
    done = subprocess.run(command, input=data, capture_output=True, check=False)
    if done.returncode:
        said = done.stderr.decode(errors="replace").strip().rpartition("\n")[2]
        raise _unreadable(path, said if done.returncode == 1 else "its reader crashed")
    with np.load(io.BytesIO(done.stdout)) as held:
        names, whole, *columns = (held[f"arr_{number}"] for number in range(len(held.files)))
    return dict(zip(names.tolist(), columns, strict=True)), whole.tolist()


def _unreadable(path: Path, reason: str) -> RecordingError:
    what = f"is no readable MATLAB file ({reason})"
    return RecordingError(path, what, "save it again")


_COMPRESSED_ELEMENT = 15
"""The type of a compressed element."""


def _decompressed(data: bytes) -> Iterator[bytes]:
    """Yield the decompressed elements of a file, about a megabyte at a time."""
    order: Literal["little", "big"] = "little" if data[126:128] == b"IM" else "big"
    at = 128
    while at + 8 <= len(data):
        kind = int.from_bytes(data[at : at + 4], order)
        size = int.from_bytes(data[at + 4 : at + 8], order)
        content = data[at + 8 : at + 8 + size]
        at += 8 + size
        if kind != _COMPRESSED_ELEMENT:
            yield content
            continue
        unpacking = zlib.decompressobj()
        with contextlib.suppress(zlib.error):
            while content:
                yield unpacking.decompress(content, 1 << 20)
                content = unpacking.unconsumed_tail


def _load_hdf5(path: Path) -> Mapping[str, Any]:
    """Read a file of version 7.3, which is HDF5."""
    try:
        import h5py  # noqa: PLC0415 (an extra)
    except ImportError:
        raise RecordingError(
            path,
            "is a MATLAB file of version 7.3, which needs h5py",
            "install multirotor-tune[matlab], or save it with '-v7'",
        ) from None
    try:
        with h5py.File(path, "r") as file:
            return _group_arrays(h5py, file, [0], 0)
    except RecordingError:
        raise
    except Exception as err:  # whatever a hostile file makes of the library
        raise _unreadable(path, short_reason(err)) from None


def _group_arrays(h5py: Any, group: Any, read: list[int], depth: int) -> dict[str, Any]:
    """Return the arrays of a group, without links to other files."""
    held: dict[str, Any] = {}
    for name in list(group)[:MAX_ARRAYS] if depth < MAX_DEPTH else ():
        if name.startswith("#") or not isinstance(group.get(name, getlink=True), h5py.HardLink):
            continue
        item = group[name]
        if isinstance(item, h5py.Group):
            held[name] = _group_arrays(h5py, item, read, depth + 1)
            continue
        own = not item.is_virtual and not item.external
        if own and item.dtype.kind in "fiu" and item.attrs.get("MATLAB_class") != b"char":
            read[0] += item.size * 8
            if read[0] > MAX_BYTES:
                raise RecordingError(
                    Path(group.file.filename), "is larger than any recording of a flight", "cut it"
                )
            held[name] = np.asarray(item).T
    return held


def _time_of(name: str, columns: Mapping[str, Array]) -> str | None:
    """Return the time column of a column's length in its structure, or in the nearest around it."""
    count = len(columns[name])
    times = [
        time
        for time, values in columns.items()
        if len(values) == count
        and (known := column_meaning(time.rpartition(".")[2])) is not None
        and known.signal == "time"
    ]
    around = name
    while around:
        around = around.rpartition(".")[0]
        near = [time for time in times if time.rpartition(".")[0] == around]
        if near:
            return near[0]
    return times[0] if times else None

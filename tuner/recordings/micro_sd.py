"""Crazyflie micro-SD logs: the firmware's uSD deck writes named variables, event by event.

A file is one byte 0xBC; the version (1 or 2) and the number of event types, two bytes each; for
each event type its number, its name and its variables, every one a name with the code of its type
behind it, as ``acc.x(f)``; then the records, each the number of its event, a time stamp (version 1:
ms in four bytes, version 2: microseconds in eight) and its variables; last a CRC-32. All is little
endian. Source: the firmware's ``usddeck.c`` and its ``cfusdlog.py``.
"""

from __future__ import annotations

import zlib
from array import array
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from tuner.core.errors import RecordingError
from tuner.recordings.notes import Cause, Damage
from tuner.recordings.recording import (
    NS_PER_UNIT,
    Clock,
    ReadResult,
    Recording,
    Topic,
    TopicSamples,
)

MAGIC = 0xBC
#: Logs are read into memory; a kilohertz of ten variables is 3 MB a minute.
MAX_LOG_BYTES = 128 << 20
#: Bytes of the CRC at the end.
CHECKSUM_BYTES = 4
#: No firmware logs more.
MAX_EVENTS, MAX_VARIABLES, MAX_NAME_BYTES = 256, 512, 256
#: Codes of types, which are NumPy's.
TYPES = frozenset("bBhHiIqQefd")
_STAMPS = {1: ("<u4", NS_PER_UNIT["ms"]), 2: ("<u8", NS_PER_UNIT["us"])}
#: Fields of every record beside its variables, whose names have no space.
_NUMBER, _STAMP = " number", " stamp"
#: Record size and positions of an event that the header lacks.
_UNKNOWN_EVENT = (MAX_LOG_BYTES + 1, array("I"))


@dataclass(frozen=True)
class _Event:
    """One event type: its name, the layout of its records, and their positions in the file."""

    name: str
    layout: np.dtype[np.void]
    places: array[int] = field(default_factory=lambda: array("I"))


class MicroSdRecording(Recording):
    """A micro-SD log; every event type is a topic, every variable a field.

    Raises
    ------
    RecordingError
        The file is no readable log.
    """

    format = "micro_sd"

    def __init__(self, path: Path) -> None:
        self.path = path
        if path.stat().st_size > MAX_LOG_BYTES:
            raise RecordingError(path, "is larger than any log of a flight", "cut it")
        self._data = path.read_bytes()
        header = _Header(path, self._data)
        events, self._unit = header.events(), header.unit
        self._crc_matches = zlib.crc32(self._data[:-4]) == int.from_bytes(self._data[-4:], "little")
        end = len(self._data) - (CHECKSUM_BYTES if self._crc_matches else 0)
        self._lost = end - _find_records(self._data, header.at, end, events)
        self._events = {event.name: event for event in events.values()}
        self.topics = tuple(
            Topic(name, "log", len(event.places)) for name, event in self._events.items()
        )

    def fields(self, topic: str) -> list[str]:
        """Return the variables of an event."""
        names = self._events[topic].layout.names if topic in self._events else ()
        return [name for name in names or () if name not in (_NUMBER, _STAMP)]

    def read(
        self,
        wanted: Mapping[str, tuple[str, ...]],
        clocks: tuple[Clock, ...] = (),  # noqa: ARG002
    ) -> ReadResult:
        """Read the wanted variables of some events."""
        samples = {name: self._samples(name, fields) for name, fields in wanted.items()}
        return ReadResult(samples, damage=self._damage())

    def _damage(self) -> tuple[Damage, ...]:
        """Return the damage that checksum and end of the file show."""
        if self._crc_matches and not self._lost:
            return ()
        if (
            self._crc_matches or self._lost == CHECKSUM_BYTES
        ):  # whole records, which are not as written
            return (Damage(Cause.LOG_DAMAGED),)
        return (Damage(Cause.END_MISSING, bytes_lost=self._lost),)

    def _samples(self, topic: str, fields: tuple[str, ...]) -> TopicSamples:
        event = self._events[topic]
        places = np.frombuffer(event.places, dtype=np.uint32).astype(np.intp)
        data = np.frombuffer(self._data, dtype=np.uint8)
        rows = data[places[:, None] + np.arange(event.layout.itemsize)].reshape(-1)
        rows = rows.view(event.layout)
        latest = np.uint64(np.iinfo(np.int64).max // self._unit)
        time = np.minimum(rows[_STAMP].astype(np.uint64), latest).astype(np.int64) * self._unit
        with np.errstate(invalid="ignore"):  # a signalling NaN of a damaged log
            return TopicSamples(
                time, time, {name: rows[name].astype(np.float64) for name in fields}
            )


class _Header:
    """The part of a log before its records, read from left to right."""

    def __init__(self, path: Path, data: bytes) -> None:
        self._path, self._data, self.at = path, data, 1
        version, self._count = self._whole_number(), self._whole_number()
        if data[0] != MAGIC or version not in _STAMPS:
            raise RecordingError(
                path, f"is a micro-SD log of version {version}", "known are versions 1 and 2"
            )
        self._stamp, self.unit = _STAMPS[version]

    def events(self) -> dict[int, _Event]:
        """Read the event types: number -> event."""
        if not 0 < self._count <= MAX_EVENTS:
            raise self._header_error(f"{self._count} event types")
        events = {}
        for _ in range(self._count):
            number, name, count = self._whole_number(), self._name(), self._whole_number()
            if count > MAX_VARIABLES:
                raise self._header_error(f"{count} variables")
            names, formats = [_NUMBER, _STAMP], ["<u2", self._stamp]
            for _ in range(count):
                variable, _, code = self._name().removesuffix(")").rpartition("(")
                if code not in TYPES or not variable or variable in names:
                    raise self._header_error(f"the variable '{variable[:40]}'")
                names.append(variable)
                formats.append(f"<{code}")
            if number in events:
                raise self._header_error(f"two event types {number}")
            events[number] = _Event(name, np.dtype({"names": names, "formats": formats}))
        if len({event.name for event in events.values()}) < len(events):
            raise self._header_error("two event types of one name")
        return events

    def _whole_number(self) -> int:
        part = self._data[self.at : self.at + 2]
        if len(part) < 2:
            raise self._header_error("an end inside it")
        self.at += 2
        return int.from_bytes(part, "little")

    def _name(self) -> str:
        end = self._data.find(b"\0", self.at, self.at + MAX_NAME_BYTES)
        if end < 0:
            raise self._header_error("a name without an end")
        name, self.at = self._data[self.at : end].decode(errors="replace"), end + 1
        return "".join(letter if letter.isprintable() else "�" for letter in name)

    def _header_error(self, what: str) -> RecordingError:
        return RecordingError(
            self._path, f"is no readable micro-SD log: its header has {what}", "record it again"
        )


def _find_records(data: bytes, at: int, end: int, events: Mapping[int, _Event]) -> int:
    """Add the positions of each event's records; return the position after the last whole one."""
    found = {n: (event.layout.itemsize, event.places) for n, event in events.items()}
    while at + 2 <= end:
        size, places = found.get(data[at] | data[at + 1] << 8, _UNKNOWN_EVENT)
        if at + size > end:
            break
        places.append(at)
        at += size
    return at

"""PX4 ULog files: the wanted messages, in PX4's own frames until the topic map turns them.

pyulog reads the messages. What comes before is a check and a count without it: pyulog multiplies
out a log's formats, and 77 bytes whose formats nest kept it busy for over 25 s, where this refuses
them in 0.14 s; it also reports nothing of the bytes behind the last whole message of a cut log.
"""

from __future__ import annotations

import contextlib
import io
import re
import struct
from collections import Counter
from collections.abc import Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from tuner.core.errors import RecordingError
from tuner.recordings.notes import Cause, Damage
from tuner.recordings.px4 import USUAL
from tuner.recordings.recording import (
    NANOSECONDS,
    Clock,
    Contents,
    Recording,
    Request,
    Samples,
    Topic,
    Usual,
    reason_of,
)

#: A ULog message cannot be longer; a format that claims so is no honest one.
LONGEST_MESSAGE = 65_535
#: What a log begins with.
MAGIC = b"ULog\x01\x12\x35"
#: Logs are read into memory; PX4 writes some 10 MB a minute.
LARGEST = 4 << 30
#: Bytes that are looked through at once.
READ_AT_ONCE = 1 << 22

#: Message -> its fields: type, number, name.
Formats = dict[str, list[tuple[str, int, str]]]


class ULogRecording(Recording):
    """A PX4 log.

    A further instance of a message is the topic ``name[1]``.

    Attributes
    ----------
    parameters
        Name -> value at the log's beginning.

    Raises
    ------
    RecordingError
        The file is no readable log.
    """

    format = "ulog"

    def __init__(self, path: Path) -> None:
        self.path = path
        if path.stat().st_size > LARGEST:
            raise RecordingError(path, "is larger than any log of a flight", "cut it")
        self._formats, self.parameters, start = _definitions(path)
        counts, ids, self._behind = _count(path, start)
        self.topics = tuple(
            sorted(
                (Topic(name, ids[number], count) for number, (name, count) in counts.items()),
                key=lambda topic: topic.name,
            )
        )

    def usual(self, topic: str, signal: str) -> Usual | None:
        """Return where a message holds a signal."""
        return USUAL.get(topic.partition("[")[0], {}).get(signal)

    def fields(self, topic: str) -> list[str]:
        """Return the names of a message's fields."""
        return [name for _, _, name in self._formats.get(topic.partition("[")[0], [])]

    def lacking(self, topic: str, fields: tuple[str, ...]) -> tuple[str, ...]:
        """Return those of some fields that a message does not have."""
        kind = topic.partition("[")[0]
        return tuple(path for path in fields if not _has(self._formats, kind, path.split(".")))

    def read(self, wanted: Mapping[str, Request]) -> Contents:
        """Read the wanted fields of some messages."""
        names = sorted({topic.partition("[")[0] for topic in wanted})
        log, complaint = _parse(self.path, names)
        samples = {}
        for data in log.data_list:
            topic = data.name if data.multi_id == 0 else f"{data.name}[{data.multi_id}]"
            if topic in wanted:
                samples[topic] = self._samples(topic, data.data, wanted[topic])
        damage = []
        if log.dropouts:
            starts = [dropout.timestamp * 1e-6 for dropout in log.dropouts]
            end = starts[-1] + log.dropouts[-1].duration * 1e-3
            damage.append(
                Damage(
                    Cause.LOGGER_DROPOUTS,
                    occurrences=len(starts),
                    seconds_lost=1e-3 * sum(dropout.duration for dropout in log.dropouts),
                    start=starts[0],
                    end=end,
                )
            )
        if log.file_corruption or complaint:
            damage.append(Damage(Cause.LOG_DAMAGED))
        if self._behind:
            last = log.last_timestamp * 1e-6
            damage.append(Damage(Cause.END_MISSING, bytes_lost=self._behind, start=last))
        return Contents(samples, damage=tuple(damage))

    def _samples(self, topic: str, data: Mapping[str, Any], request: Request) -> Samples:
        if "timestamp" not in data:
            raise RecordingError(self.path, f"{topic} has no timestamp", "leave it out of the map")
        receive = data["timestamp"].astype(np.int64) * NANOSECONDS["us"]
        clocks = (*request.clocks, Clock(field="timestamp_sample", unit="us"))
        stamp = receive
        for clock in clocks:
            if clock.field in data:
                sampled = data[clock.field].astype(np.int64) * clock.nanoseconds
                stamp = np.where(sampled > 0, sampled, receive)
                break
        missing = [name for name in request.fields if name not in data]
        if missing:
            raise RecordingError(
                self.path,
                f"{topic} has no field '{missing[0]}', it has {', '.join(list(data)[:12])}",
                "correct the topic map",
            )
        fields = {name: data[name].astype(np.float64) for name in request.fields}
        return Samples(receive, stamp, fields)


def _blocks(path: Path, at: int) -> Iterator[tuple[bytes, list[int]]]:
    """Yield blocks of a log, each with where its whole messages begin, and the end of the last."""
    with path.open("rb") as stream:
        stream.seek(at)
        rest = b""
        while block := stream.read(READ_AT_ONCE):
            buffer, places, here = rest + block, [0], 0
            last, keep = len(buffer) - 3, places.append
            while here <= last:
                here += 3 + (buffer[here] | buffer[here + 1] << 8)
                keep(here)
            if places[-1] > len(buffer):
                places.pop()
            rest = buffer[places[-1] :]
            if len(places) > 1:
                yield buffer, places


def _definitions(path: Path) -> tuple[Formats, dict[str, float], int]:
    """Return formats and parameters of a log, and where its data begin; formats are checked."""
    with path.open("rb") as stream:
        if not stream.read(16).startswith(MAGIC) or stream.tell() < 16:
            raise RecordingError(path, "is no PX4 log", "give the .ulg file itself")
    formats: Formats = {}
    parameters: dict[str, float] = {}
    start = 16
    blocks = ((buffer, pair) for buffer, at in _blocks(path, start) for pair in pairwise(at))
    for buffer, (begin, behind) in blocks:
        kind, content = buffer[begin + 2], buffer[begin + 3 : behind]
        if kind in b"ALCD":
            break
        start += 3 + len(content)
        if kind == ord("F"):
            name, _, fields = content.decode(errors="replace").partition(":")
            parts = re.findall(r"([\w/]+)(?:\[(\d{1,6})\])? (\w+);", fields)
            formats[name] = [(what, int(count or 1), field) for what, count, field in parts]
        elif kind == ord("P") and content:
            word, _, name = content[1 : 1 + content[0]].decode(errors="replace").partition(" ")
            form = {"float": "<f", "int32_t": "<i"}.get(word)
            if form is not None and len(content) == 1 + content[0] + 4:
                parameters[name] = float(struct.unpack_from(form, content, 1 + content[0])[0])
    for name in formats:
        if _size(formats, name, 0) > LONGEST_MESSAGE:
            raise RecordingError(path, f"the format of {name} is absurd", "record it again")
    return formats, parameters, start


def parameters_of(path: Path) -> dict[str, float]:
    """Return the parameters at the beginning of a PX4 log; none of what is no such log."""
    with contextlib.suppress(OSError, RecordingError):
        return _definitions(path)[1]
    return {}


def _has(formats: Formats, kind: str, path: list[str]) -> bool:
    """Return whether a format has a field such as ``esc[0].esc_rpm``, in its parts."""
    name, _, index = path[0].partition("[")
    for what, count, field in formats.get(kind, []):
        if field == name:
            number = int(index[:-1]) if index[:-1].isdecimal() else 0
            inside = number < count and bool(index) == (count > 1)
            return inside and (len(path) == 1 or _has(formats, what, path[1:]))
    return False


def _size(formats: Formats, name: str, depth: int) -> int:
    """Return the numbers in a format, at most a little more than a message can hold."""
    if depth > 8:
        return LONGEST_MESSAGE + 1
    total = 0
    for what, count, _ in formats[name]:
        inner = _size(formats, what, depth + 1) if what in formats else 1
        total += max(1, inner) * count
        if total > LONGEST_MESSAGE:
            break
    return total


def _count(path: Path, start: int) -> tuple[dict[int, tuple[str, int]], dict[int, str], int]:
    """Count the messages of each subscription, and the bytes behind the last whole record."""
    names: dict[int, str] = {}
    kinds: dict[int, str] = {}
    counts: Counter[int] = Counter()
    reached = start
    for buffer, places in _blocks(path, start):
        content = np.frombuffer(buffer, dtype=np.uint8)
        at = np.array(places[:-1], dtype=np.int64)
        kind, size = content[at + 2], np.diff(places) - 3
        data = at[(kind == ord("D")) & (size >= 2)]
        numbers = content[data + 3] | content[data + 4].astype(np.int64) << 8
        counts.update(
            dict(zip(*(x.tolist() for x in np.unique(numbers, return_counts=True)), strict=True))
        )
        for first in at[(kind == ord("A")) & (size >= 4)].tolist():
            length = buffer[first] | buffer[first + 1] << 8
            instance, number = struct.unpack_from("<BH", buffer, first + 3)
            kinds[number] = buffer[first + 6 : first + 3 + length].decode(errors="replace")
            names[number] = kinds[number] if instance == 0 else f"{kinds[number]}[{instance}]"
        reached += places[-1]
    counted = {number: (name, counts[number]) for number, name in names.items()}
    return counted, kinds, path.stat().st_size - reached


def _parse(path: Path, names: list[str]) -> tuple[Any, str]:
    """Parse a log with pyulog, which prints what it finds wrong."""
    from pyulog import ULog  # noqa: PLC0415 (slow to import)

    printed = io.StringIO()
    try:
        with contextlib.redirect_stdout(printed):
            return ULog(str(path), names), printed.getvalue()
    except Exception as err:  # pyulog's own and whatever a hostile log makes of it
        what = f"is no readable PX4 log ({reason_of(err)})"
        raise RecordingError(path, what, "record it again") from None

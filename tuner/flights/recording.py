"""What every reader hands over: the topics of a file, and the wanted fields as arrays."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tuner.flights.flight import Array, Note

Nanoseconds = NDArray[np.int64]


@dataclass(frozen=True)
class Topic:
    """A topic of a recording: its name, message type and number of messages."""

    name: str
    type: str
    count: int


@dataclass(frozen=True)
class Samples:
    """The messages of one topic, in the order of the file.

    Attributes
    ----------
    receive
        (n,) ns, when each message was recorded.
    stamp
        (n,) ns, the time written in each message's header; None where the type has no header.
    fields
        Field path -> (n,) numbers as recorded; NaN where a message has no such element.
    """

    receive: Nanoseconds
    stamp: Nanoseconds | None
    fields: Mapping[str, Array]


@dataclass(frozen=True)
class Usual:
    """Where a message type holds a signal: its fields and their unit, a key of `UNITS`."""

    fields: tuple[str, ...]
    unit: str = "si"


@dataclass(frozen=True)
class Contents:
    """The wanted topics of one recording.

    Attributes
    ----------
    samples
        Topic -> its messages.
    notes
        What was lost while reading.
    """

    samples: Mapping[str, Samples]
    notes: tuple[Note, ...] = field(default=())


class Recording(Protocol):
    """An open file of any format."""

    @property
    def path(self) -> Path:
        """Where the recording lies."""
        ...

    @property
    def format(self) -> str:
        """``ros``, ``ulog`` or ``table``: what a topic map's ``format`` is matched with."""
        ...

    @property
    def topics(self) -> Sequence[Topic]:
        """Every topic in the file."""
        ...

    def usual(self, topic: str, signal: str) -> Usual | None:
        """Return where messages of this topic's type hold a signal; None if they do not."""
        ...

    def read(self, wanted: Mapping[str, Sequence[str]]) -> Contents:
        """Read some topics: topic -> paths of the wanted fields."""
        ...


def digest(path: Path) -> str:
    """Return the SHA-256 of a file, or of all the files in a folder with their names."""
    files = sorted(file for file in path.rglob("*") if file.is_file()) if path.is_dir() else [path]
    total = hashlib.sha256()
    for file in files:
        if path.is_dir():
            total.update(str(file.relative_to(path)).encode())
        with file.open("rb") as stream:
            while block := stream.read(1 << 20):
                total.update(block)
    return total.hexdigest()

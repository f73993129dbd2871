"""The interface of readers: the topics of a recording, and requested fields as arrays."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import model_validator

from tuner.core.errors import RecordingError
from tuner.core.numerics import Array
from tuner.core.yaml_section import Section
from tuner.recordings.notes import Damage, Note

Nanoseconds = NDArray[np.int64]
NS_PER_SECOND = 1_000_000_000
#: Unit of time -> nanoseconds.
NS_PER_UNIT = {"s": NS_PER_SECOND, "ms": 1_000_000, "us": 1_000, "ns": 1}


#: The one topic of a table.
TABLE_TOPIC = ""


@dataclass(frozen=True)
class Topic:
    """A topic of a recording: its name, message type and number of messages."""

    name: str
    type: str
    count: int


class Clock(Section):
    """A field that holds the time of a message, or of a table's row.

    Attributes
    ----------
    field
        Its path or column.
    unit
        Key of `NS_PER_UNIT`; None means seconds in messages; tables infer it from the step.
    """

    field: str
    unit: Literal["s", "ms", "us", "ns"] | None = None

    @property
    def nanoseconds(self) -> int:
        """The ns in its unit."""
        return NS_PER_UNIT[self.unit or "s"]

    @model_validator(mode="before")
    @classmethod
    def _from_name(cls, value: Any) -> Any:
        return {"field": value} if isinstance(value, str) else value


@dataclass(frozen=True)
class TopicSamples:
    """The messages of one topic, in the order of the file.

    Attributes
    ----------
    receive
        (n,) ns, when each message was recorded.
    stamp
        (n,) ns, the time written in each message; None where it has none.
    fields
        Field path -> (n,) numbers as recorded; NaN where a message has no such element.
    """

    receive: Nanoseconds
    stamp: Nanoseconds | None
    fields: Mapping[str, Array]


@dataclass(frozen=True)
class FieldLayout:
    """Where a message type holds a signal: its fields, their unit (of `UNITS`) and axes."""

    fields: tuple[str, ...]
    unit: str = "si"
    frame: str = "enu_flu"

    @classmethod
    def of(cls, pattern: str, unit: str = "si", frame: str = "enu_flu") -> FieldLayout:
        """Return the layout with the fields of a pattern: ``v[{0,1}]`` is ``v[0]``, ``v[1]``."""
        before, _, rest = pattern.partition("{")
        parts, _, behind = rest.partition("}")
        return cls(tuple(f"{before}{part}{behind}" for part in parts.split(",")), unit, frame)


@dataclass(frozen=True)
class ReadResult:
    """The wanted topics of one recording.

    Attributes
    ----------
    samples
        Topic -> its messages.
    notes
        Which data were left out while reading.
    damage
        What the recording has lost, with times in s since 1970 by the recorder's clock.
    """

    samples: Mapping[str, TopicSamples]
    notes: tuple[Note, ...] = ()
    damage: tuple[Damage, ...] = ()


class Recording(ABC):
    """An open file of any format.

    Attributes
    ----------
    format
        The `Reader.format` by which it was opened.
    parameters
        Of the flight controller, where its log holds them: name -> value.
    units
        Column of a table -> its unit, where the table has a row of units.
    naming_problem
        Why its columns cannot be matched by name, and the remedy; None where they can.
    """

    path: Path
    format: str
    topics: Sequence[Topic]
    parameters: Mapping[str, float] = {}
    units: Mapping[str, str] = {}
    naming_problem: tuple[str, str] | None = None

    def field_layout(self, topic: str, signal: str) -> FieldLayout | None:  # noqa: ARG002
        """Return where messages of this topic's type hold a signal; None if they do not."""
        return None

    @abstractmethod
    def fields(self, topic: str) -> Sequence[str]:
        """Return the names of a topic's fields, for hints; structures by their first part."""

    def missing_fields(self, topic: str, fields: tuple[str, ...]) -> tuple[str, ...]:
        """Return the fields that messages of a topic do not have."""
        known = self.fields(topic)
        return tuple(name for name in fields if name not in known)

    def is_defined(self, topic: str) -> bool:  # noqa: ARG002
        """Return whether the definition of a topic's message type is known."""
        return True

    @abstractmethod
    def read(
        self, wanted: Mapping[str, tuple[str, ...]], clocks: tuple[Clock, ...] = ()
    ) -> ReadResult:
        """Read the requested fields of some topics.

        Parameters
        ----------
        wanted
            Topic -> paths of numbers.
        clocks
            Fields that may hold the time, the preferred one first; empty means the message's
            header.

        Raises
        ------
        RecordingError
            A topic has no such field, or nothing can be read.
        """


class TabularRecording(Recording):
    """A table with one row per time and one number per column; the base of tabular formats.

    Parameters
    ----------
    format_name
        The `Reader.format`.
    """

    def __init__(self, path: Path, format_name: str, columns: Sequence[str]) -> None:
        self.path = path
        self.format = format_name
        self.columns = columns
        self.topics = (Topic(TABLE_TOPIC, "table", 1),)

    def fields(self, topic: str) -> Sequence[str]:  # noqa: ARG002
        """Return the columns."""
        return self.columns

    def clock(self, clocks: tuple[Clock, ...]) -> Clock:
        """Return the first of some clocks that it has a column of.

        Raises
        ------
        RecordingError
            It has no requested time column.
        """
        for clock in clocks:
            if clock.field in self.columns:
                return clock
        raise RecordingError(
            self.path,
            f"has no time column among {', '.join(self.columns[:8])}, ...",
            "name it under 'time' in the topic map",
        )

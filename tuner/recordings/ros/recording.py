"""A ROS recording of any container: topics, and their wanted fields as arrays."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tuner.core.errors import RecordingError
from tuner.recordings import px4
from tuner.recordings.notes import Cause, Damage
from tuner.recordings.recording import (
    Clock,
    Contents,
    Nanoseconds,
    Recording,
    Request,
    Samples,
    Topic,
    Usual,
)
from tuner.recordings.ros.bag1 import Bag1
from tuner.recordings.ros.container import Connection, Container
from tuner.recordings.ros.folder import Folder, open_file
from tuner.recordings.ros.messages import USUAL, Definitions
from tuner.recordings.ros.wire import UnknownFieldError, Walk, decode, missing_fields, plan

_SECONDS, _NANOSECONDS = "header.stamp.sec", "header.stamp.nanosec"


def open_container(path: Path) -> Container:
    """Open the container of a ROS recording by what it begins with."""
    if path.is_dir():
        return Folder(path)
    with path.open("rb") as stream:
        magic = stream.read(7)
    return Bag1(path) if magic in (b"#ROSBAG", b"") else open_file(path)


class RosRecording(Recording):
    """Topics of a ROS container.

    Parameters
    ----------
    path
        The recording.
    container
        Its opened container.
    messages
        ``.msg`` files for types that the container does not define.
    """

    format = "ros"

    def __init__(self, path: Path, container: Container, messages: tuple[Path, ...] = ()) -> None:
        self.path = path
        self._container = container
        texts = {c.type: c.definition for c in container.connections.values()}
        self._definitions = Definitions(path, texts, messages, standard=container.aligned)
        counts: Counter[tuple[str, str]] = Counter()
        for connection in container.connections.values():
            counts[connection.topic, connection.type] += connection.count
        self.topics = tuple(
            Topic(name, kind, count) for (name, kind), count in sorted(counts.items())
        )

    @property
    def damage(self) -> tuple[Damage, ...]:
        """What of the container could not be read so far."""
        return tuple(self._container.damage)

    def usual(self, topic: str, signal: str) -> Usual | None:
        """Return where messages of this topic's type hold a signal."""
        kind = self._kind(topic)
        if kind.startswith("px4_msgs/"):
            return px4.USUAL.get(px4.log_name(kind), {}).get(signal)
        return USUAL.get(kind, {}).get(signal)

    def fields(self, topic: str) -> list[str]:
        """Return the names of the fields of a topic's messages."""
        try:
            return [name for name, _ in self._definitions.fields(self._kind(topic))]
        except RecordingError:
            return []

    def lacking(self, topic: str, fields: tuple[str, ...]) -> tuple[str, ...]:
        """Return those of some fields that a topic's messages do not have."""
        try:
            return missing_fields(self._definitions, self._kind(topic), fields)
        except (UnknownFieldError, RecordingError):
            return fields

    def undefined(self, topic: str) -> str | None:
        """Return the message type of a topic if its definition is nowhere; None if it is known."""
        kind = self._kind(topic)
        try:
            self._definitions.fields(kind)
        except RecordingError:
            return kind
        return None

    def _kind(self, topic: str) -> str:
        return next((known.type for known in self.topics if known.name == topic), "")

    def read(self, wanted: Mapping[str, Request]) -> Contents:
        """Read the wanted fields of some topics."""
        walks: dict[int, tuple[Walk, Clock | None]] = {}
        for connection in self._container.connections.values():
            if connection.topic in wanted and connection.count:
                walks[connection.id] = self._plan(connection, wanted[connection.topic])
        parts: dict[str, list[Samples]] = {name: [] for name in wanted}
        broken: dict[str, int] = dict.fromkeys(wanted, 0)
        for number, block in self._container.blocks(walks):
            walk, clock = walks[number]
            columns, whole = decode(walk, block)
            topic = self._container.connections[number].topic
            broken[topic] += int(len(whole) - whole.sum())
            parts[topic].append(_samples(columns, whole, block.time, clock))
        cut = [
            Damage(Cause.MESSAGES_DAMAGED, topic, lost=count)
            for topic, count in broken.items()
            if count
        ]
        samples = {name: _joined(rows) for name, rows in parts.items() if rows}
        return Contents(samples, damage=(*self.damage, *cut))

    def _has(self, kind: str, path: str) -> bool:
        return not missing_fields(self._definitions, kind, (path,))

    def _plan(self, connection: Connection, request: Request) -> tuple[Walk, Clock | None]:
        """Plan how to reach the wanted fields and the time."""
        kind = connection.type
        fields = list(request.fields)
        try:
            clock = next((c for c in request.clocks if self._has(kind, c.field)), None)
            if clock is not None:
                fields.append(clock.field)
            elif self._has(kind, _SECONDS):
                fields += [_SECONDS, _NANOSECONDS]
            walk = plan(self._definitions, kind, fields, aligned=self._container.aligned)
        except UnknownFieldError as err:
            raise RecordingError(
                self.path, f"{connection.topic}: {err}", "correct the topic map"
            ) from None
        return walk, clock


def _samples(
    columns: dict[str, NDArray[Any]],
    whole: NDArray[np.bool_],
    receive: Nanoseconds,
    clock: Clock | None,
) -> Samples:
    kept = {name: values[whole] for name, values in columns.items()}
    stamp = None
    if clock is not None:
        stamp = kept.pop(clock.field).astype(np.int64) * clock.nanoseconds
    elif _SECONDS in kept:
        seconds = kept.pop(_SECONDS).astype(np.int64)
        stamp = seconds * 1_000_000_000 + kept.pop(_NANOSECONDS).astype(np.int64)
    return Samples(
        receive[whole],
        stamp,
        {name: values.astype(np.float64) for name, values in kept.items()},
    )


def _joined(parts: list[Samples]) -> Samples:
    stamps = [part.stamp for part in parts if part.stamp is not None]
    return Samples(
        np.concatenate([part.receive for part in parts]),
        np.concatenate(stamps) if len(stamps) == len(parts) else None,
        {name: np.concatenate([part.fields[name] for part in parts]) for name in parts[0].fields},
    )

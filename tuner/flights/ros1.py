"""ROS 1 bags: the wanted fields of the mapped topics, nothing else deserialised."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from rosbags.rosbag1 import Reader, ReaderError
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from tuner.errors import RecordingError
from tuner.flights.recording import Contents, Samples, Topic, Usual
from tuner.flights.ros_fields import USUAL

_BROKEN = (ReaderError, SerdeError, TypesysError, AssertionError, ValueError, KeyError)


class Ros1Bag:
    """A ROS 1 bag; message types come from the bag itself.

    Raises
    ------
    RecordingError
        The file is missing or no readable bag.
    """

    format = "ros"

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            with Reader(path) as reader:
                self.topics = tuple(
                    Topic(name, info.msgtype or "", info.msgcount)
                    for name, info in sorted(reader.topics.items())
                )
        except OSError as err:
            raise RecordingError(path, err.strerror or str(err), "check the path") from None
        except _BROKEN as err:
            raise RecordingError(
                path, f"is no readable ROS 1 bag ({err})", "try 'rosbag reindex' on it"
            ) from None

    def usual(self, topic: str, signal: str) -> Usual | None:
        """Return where messages of this topic's type hold a signal."""
        kind = next((known.type for known in self.topics if known.name == topic), "")
        return USUAL.get(kind, {}).get(signal)

    def read(self, wanted: Mapping[str, Sequence[str]]) -> Contents:
        """Read the wanted fields of some topics."""
        try:
            with Reader(self.path) as reader:
                connections = [c for c in reader.connections if c.topic in wanted]
                store = _types(reader)
                rows: dict[str, list[tuple[int, int, list[float]]]] = {name: [] for name in wanted}
                getters = {name: [_getter(path) for path in wanted[name]] for name in wanted}
                for connection, receive, raw in reader.messages(connections) if connections else ():
                    message = store.deserialize_ros1(raw, connection.msgtype)
                    header = getattr(message, "header", None)
                    stamp = (
                        -1
                        if header is None
                        else header.stamp.sec * 1_000_000_000 + header.stamp.nanosec
                    )
                    values = [get(message) for get in getters[connection.topic]]
                    rows[connection.topic].append((receive, stamp, values))
        except AttributeError as err:
            raise RecordingError(self.path, str(err), "correct the topic map's fields") from None
        except _BROKEN as err:
            raise RecordingError(self.path, f"cannot be read ({err})", "record it again") from None
        return Contents({name: _samples(rows[name], wanted[name]) for name in wanted if rows[name]})


def _types(reader: Reader) -> Typestore:
    store = get_typestore(Stores.EMPTY)
    types = {}
    for connection in reader.connections:
        types.update(get_types_from_msg(connection.msgdef.data, connection.msgtype))
    store.register(types)
    return store


def _getter(path: str) -> Callable[[object], float]:
    """Return a function from a message to the number at a path such as ``channels[0]``."""
    name, _, index = path.partition("[")
    attribute = operator.attrgetter(name)
    if not index:
        return lambda message: float(attribute(message))
    position = int(index.rstrip("]"))

    def element(message: object) -> float:
        array = attribute(message)
        return float(array[position]) if position < len(array) else math.nan

    return element


def _samples(rows: list[tuple[int, int, list[float]]], fields: Sequence[str]) -> Samples:
    receive = np.array([row[0] for row in rows], dtype=np.int64)
    stamp = np.array([row[1] for row in rows], dtype=np.int64)
    values = np.array([row[2] for row in rows], dtype=np.float64)
    columns = {name: values[:, i] for i, name in enumerate(fields)}
    return Samples(receive, None if (stamp < 0).all() else stamp, columns)

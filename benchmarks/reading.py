"""The speed of reading recordings, beside rosbags' deserialisation of the same topics.

The circle that ships with the project is repeated until the recording is a few minutes long, as
ROS 1 bag, SQLite and MCAP. Seconds of one processor, the best of three.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Reader, Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from benchmarks.table import ResultSection
from tuner.recordings.formats import open_recording
from tuner.recordings.sources import choose_map, locate
from tuner.recordings.topics import shipped_maps

CIRCLE = Path(__file__).parents[1] / "reference_flights" / "circle_3mps.bag"


def lengthen(target: Path, repeat: int) -> Path:
    """Write the circle several times in a row into one bag."""
    with Reader(CIRCLE) as reader, Writer(target) as writer:
        connections = {
            c.id: writer.add_connection(c.topic, c.msgtype, msgdef=c.msgdef.data, md5sum=c.digest)
            for c in reader.connections
        }
        messages = [(connections[c.id], when, bytes(raw)) for c, when, raw in reader.messages()]
        for again in range(repeat):
            for connection, when, raw in messages:
                writer.write(connection, when + again * 41_000_000_000, raw)
    return target


def to_ros2(bag: Path, folder: Path, storage: StoragePlugin) -> Path:
    """Write a ROS 1 bag as ROS 2 does."""
    store = get_typestore(Stores.EMPTY)
    with Reader(bag) as reader, Writer2(folder, version=9, storage_plugin=storage) as writer:
        types = {}
        for connection in reader.connections:
            types.update(get_types_from_msg(connection.msgdef.data, connection.msgtype))
        header = get_typestore(Stores.ROS2_HUMBLE).fielddefs["std_msgs/msg/Header"]
        store.register({**types, "std_msgs/msg/Header": header})
        connections = {
            c.id: writer.add_connection(c.topic, c.msgtype, typestore=store)
            for c in reader.connections
        }
        for connection, when, raw in reader.messages():
            writer.write(
                connections[connection.id], when, store.ros1_to_cdr(raw, connection.msgtype)
            )
    return folder


Wanted = dict[str, tuple[str, ...]]
"""Topic -> fields."""


def wanted(path: Path) -> Wanted:
    """Return the fields of a recording that a flight needs."""
    recording = open_recording(path)
    places, _ = locate(recording, choose_map(recording, shipped_maps(recording.format)))
    fields: dict[str, list[str]] = {}
    for place in places.values():
        rotor = [place.source.rotor] if place.source.rotor else []
        fields.setdefault(place.topic, []).extend([*place.fields, *rotor])
    return {topic: tuple(names) for topic, names in fields.items()}


def with_rosbags(path: Path, requests: Wanted) -> int:
    """Deserialise the wanted topics with rosbags; return how many messages."""
    count = 0
    with AnyReader([path]) as reader:
        connections = [c for c in reader.connections if c.topic in requests]
        for connection, _, raw in reader.messages(connections):
            reader.deserialize(raw, connection.msgtype)
            count += 1
    return count


def with_tuner(path: Path, requests: Wanted) -> int:
    """Read the wanted fields; return how many messages."""
    contents = open_recording(path).read(requests)
    return sum(len(samples.receive) for samples in contents.samples.values())


def best(work: Callable[[Path, Wanted], int], path: Path) -> tuple[float, int]:
    """Return the least processor time of three, and the count."""
    requests = wanted(path)
    times = []
    for _ in range(3):
        started = time.process_time()
        count = work(path, requests)
        times.append(time.process_time() - started)
    return min(times), count


def measure(repeat: int = 8) -> ResultSection:
    """Read the lengthened circle in three formats."""
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        bag = lengthen(Path(scratch) / "long.bag", repeat)
        paths = {"ROS 1 bag": bag}
        for storage in StoragePlugin:
            folder = to_ros2(bag, Path(scratch) / storage.name, storage)
            paths[f"ROS 2 {storage.name}"] = folder
        for name, path in paths.items():
            files = [path] if path.is_file() else list(path.iterdir())
            size = sum(file.stat().st_size for file in files) / 1e6
            slow, count = best(with_rosbags, path)
            quick, same = best(with_tuner, path)
            if count != same:
                raise SystemExit(f"{name}: rosbags reads {count} messages, tune {same}")
            rows.append(
                [
                    name,
                    f"{size:.0f}",
                    str(count),
                    f"{slow:.2f}",
                    f"{quick:.2f}",
                    f"{slow / quick:.0f}",
                ]
            )
    return ResultSection(
        "Reading",
        "The circle that ships with the project, repeated; processor seconds, the best of three, "
        "beside rosbags' own deserialisation of the same topics.",
        ["recording", "MB", "messages", "rosbags s", "tune s", "times quicker"],
        rows,
    )

"""Large recordings: quick, in little memory, and without reading what nobody asked for."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag1 import Reader, Writer
from rosbags.typesys import Stores, get_typestore

from tests.tuner.recordings import making

pytestmark = pytest.mark.skipif(
    not Path("/proc/self/io").exists(), reason="counts bytes and memory as Linux reports them"
)
IMAGE = "sensor_msgs/msg/Image"
#: Reads a recording in a process of its own; prints seconds, bytes read and the peak of memory.
MEASURE = """
import json, pathlib, sys, time
from tuner.recordings.content import ReadOptions, read_content
def read():
    lines = pathlib.Path("/proc/self/io").read_text().split()
    return int(lines[lines.index("rchar:") + 1])
before, started = read(), time.process_time()
content = read_content(ReadOptions(pathlib.Path(sys.argv[1])))
# Not getrusage's: that remembers the process from which this one was forked.
lines = pathlib.Path("/proc/self/status").read_text().split()
peak = int(lines[lines.index("VmHWM:") + 1])
print(json.dumps({
    "cpu": time.process_time() - started, "read": read() - before, "peak": peak * 1024,
    "count": len(content.series["position"].time),
}))
"""


def measure(path: Path) -> dict[str, float]:
    run = subprocess.run(
        [sys.executable, "-c", MEASURE, str(path)], capture_output=True, text=True, check=True
    )
    result: dict[str, float] = json.loads(run.stdout)
    return result


def test_a_camera_beside_the_flight_is_not_read(tmp_path: Path) -> None:
    """240 MB of images between 2 MB of flight."""
    store = get_typestore(Stores.ROS1_NOETIC)
    text, md5 = store.generate_msgdef(IMAGE, ros_version=1)
    header = store.types["std_msgs/msg/Header"]
    time_of = store.types["builtin_interfaces/msg/Time"]
    pixels = np.random.default_rng(0).integers(0, 255, 1 << 20, dtype=np.uint8)
    path = tmp_path / "camera.bag"
    with Reader(making.CIRCLE) as reader, Writer(path) as writer:
        connections = {
            c.id: writer.add_connection(c.topic, c.msgtype, msgdef=c.msgdef.data, md5sum=c.digest)
            for c in reader.connections
        }
        camera = writer.add_connection("/camera/image_raw", IMAGE, msgdef=text, md5sum=md5)
        for i, (connection, time, raw) in enumerate(reader.messages()):
            writer.write(connections[connection.id], time, raw)
            if i % 117 == 0:
                stamp = time_of(*divmod(time, 1_000_000_000))
                image = store.types[IMAGE](
                    header(i, stamp, "camera"), 1024, 1024, "mono8", 0, 1024, pixels
                )
                writer.write(camera, time, store.serialize_ros1(image, IMAGE))
    size = path.stat().st_size
    assert size > 230e6
    got = measure(path)
    assert got["count"] == 4000
    assert got["read"] < 0.1 * size
    assert got["peak"] < 200e6


def test_fifty_megabytes_within_two_seconds(tmp_path: Path) -> None:
    """Messages of a flight alone, with no image to make up the size; time of one processor."""
    path = tmp_path / "long.bag"
    shift = 41_000_000_000
    with Reader(making.CIRCLE) as reader, Writer(path) as writer:
        connections = {
            c.id: writer.add_connection(c.topic, c.msgtype, msgdef=c.msgdef.data, md5sum=c.digest)
            for c in reader.connections
        }
        messages = [(c, time, bytes(raw)) for c, time, raw in reader.messages()]
        for again in range(11):
            for connection, time, raw in messages:
                if connection.msgtype != "std_msgs/msg/Int32":
                    seconds = int.from_bytes(raw[4:8], "little") + 41 * again
                    raw = raw[:4] + seconds.to_bytes(4, "little") + raw[8:]  # noqa: PLW2901
                writer.write(connections[connection.id], time + again * shift, raw)
    assert path.stat().st_size > 50e6
    got = measure(path)
    assert got["count"] == 44_000
    assert got["cpu"] < 2.0
    assert got["peak"] < 500e6

"""Recordings for the tests: the shipped bags in other formats, and small bags of one's own."""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.rosbag1 import Reader
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

FLIGHTS = Path(__file__).parents[3] / "reference_flights"
CIRCLE = FLIGHTS / "circle_3mps.bag"

_HEADER = get_typestore(Stores.ROS2_HUMBLE).fielddefs["std_msgs/msg/Header"]


def store_of(bag: Path, *, ros2: bool) -> Any:
    """Return the message types of a bag, with the header of ROS 1 or 2."""
    with Reader(bag) as reader:
        definitions = tuple((c.msgdef.data, c.msgtype) for c in reader.connections)
    return _store_of(definitions, ros2=ros2)


@cache
def _store_of(definitions: tuple[tuple[str, str], ...], *, ros2: bool) -> Any:
    store = get_typestore(Stores.EMPTY)
    types: dict[str, Any] = {}
    for definition, name in definitions:
        types.update(get_types_from_msg(definition, name))
    if ros2:
        types["std_msgs/msg/Header"] = _HEADER
    store.register(types)
    return store


def to_ros2(
    bag: Path,
    folder: Path,
    storage: StoragePlugin,
    mode: CompressionMode = CompressionMode.NONE,
    until: float | None = None,
) -> Path:
    """Write a ROS 1 bag again as ROS 2 does."""
    store = store_of(bag, ros2=True)
    writer = Writer(folder, version=9, storage_plugin=storage)
    if mode is not CompressionMode.NONE:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    with Reader(bag) as reader, writer:
        stop = None if until is None else reader.start_time + int(until * 1e9)
        connections = {
            c.id: writer.add_connection(c.topic, c.msgtype, typestore=store)
            for c in reader.connections
        }
        for connection, time, raw in reader.messages(stop=stop):
            data = store.ros1_to_cdr(raw, connection.msgtype)
            writer.write(connections[connection.id], time, data)
    return folder


def rewrite(
    bag: Path,
    target: Path,
    change: Callable[[str, int, Any], list[tuple[int, Any]]] | None = None,
    *,
    of: Collection[str] | None = None,
    compression: str = "none",
    rename: Callable[[str], str] = lambda topic: topic,
    chunk: int | None = None,
    until: int | None = None,
) -> Path:
    """Write a bag again, each message passed through `change(topic, time, message)`.

    Those ``of`` some topics alone, where topics are given. It returns the messages to write
    instead, each with its time of recording. Those that were recorded ``until`` a time, in ns, or
    later are left out.
    """
    store = store_of(bag, ros2=False)
    writer = BagWriter(target)
    if compression != "none":
        writer.set_compression(BagWriter.CompressionFormat[compression.upper()])
    if chunk is not None:
        writer.chunk_threshold = chunk
    with Reader(bag) as reader, writer:
        connections = {
            c.id: writer.add_connection(
                rename(c.topic), c.msgtype, msgdef=c.msgdef.data, md5sum=c.digest
            )
            for c in reader.connections
        }
        for connection, time, raw in reader.messages(stop=until):
            connection_out = connections[connection.id]
            if change is None or connection.topic not in (of or {connection.topic}):
                writer.write(connection_out, time, raw)
                continue
            message = store.deserialize_ros1(raw, connection.msgtype)
            for when, changed in change(connection.topic, time, message):
                writer.write(
                    connection_out, when, store.serialize_ros1(changed, connection.msgtype)
                )
    return target


def stamped(message: Any, nanoseconds: int) -> Any:
    """Set the time in a message's header."""
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(nanoseconds, 1_000_000_000)
    return message


def stamp_of(message: Any) -> int:
    """Return the time in a message's header, in ns."""
    return int(message.header.stamp.sec) * 1_000_000_000 + int(message.header.stamp.nanosec)


@dataclass(frozen=True)
class Column:
    """Numbers on their own clock: (n,) ns and (n, k)."""

    time: np.ndarray
    values: np.ndarray


def columns_of(bag: Path, paths: Mapping[str, Sequence[str]]) -> dict[str, Column]:
    """Read fields of topics with rosbags alone, on header stamps where there are any."""
    store = store_of(bag, ros2=False)
    rows: dict[str, list[tuple[int, list[float]]]] = {topic: [] for topic in paths}
    with Reader(bag) as reader:
        wanted = [c for c in reader.connections if c.topic in paths]
        for connection, time, raw in reader.messages(wanted):
            message = store.deserialize_ros1(raw, connection.msgtype)
            when = stamp_of(message) if hasattr(message, "header") else time
            values = [_value(message, path) for path in paths[connection.topic]]
            rows[connection.topic].append((when, values))
    return {
        topic: Column(np.array([r[0] for r in samples]), np.array([r[1] for r in samples]))
        for topic, samples in rows.items()
    }


def _value(message: Any, path: str) -> float:
    for part in path.split("."):
        name, _, index = part.partition("[")
        message = getattr(message, name)
        if index:
            message = message[int(index[:-1])]
    return float(message)


_XYZ = ("x", "y", "z")
#: The shipped bags' topics: fields, and the names that a table gives them.
LAB = {
    "/optitrack/pose": {
        **{f"pose.position.{a}": a for a in _XYZ},
        **{f"pose.orientation.{a}": f"q{a}" for a in ("w", *_XYZ)},
    },
    "/mavros/local_position/velocity_local": {f"twist.linear.{a}": f"v{a}" for a in _XYZ},
    "/mavros/imu/data": {
        **{f"angular_velocity.{a}": f"w{a}" for a in _XYZ},
        **{f"linear_acceleration.{a}": f"a{a}" for a in _XYZ},
    },
    "/mavros/rpm": {"frequency": "rpm"},
    "/mavros/rc/out": {f"channels[{i}]": f"pwm_{i + 1}" for i in range(4)},
    "/mavros/setpoint_raw/attitude": {
        **{f"body_rate.{a}": f"rate_setpoint_{a}" for a in _XYZ},
        "thrust": "thrust_setpoint",
    },
    "/reference/flatsetpoint": {
        **{f"position.{a}": f"ref_{a}" for a in _XYZ},
        **{f"velocity.{a}": f"ref_v{a}" for a in _XYZ},
        **{f"acceleration.{a}": f"ref_a{a}" for a in _XYZ},
    },
    "/mavros/battery": {"voltage": "battery_voltage"},
    "/trajectory_publisher/lap_completed": {"data": "lap"},
}

#: The map for a table made by `to_frame`.
LAB_TABLE = """
name: lab_table
format: table
extends: table
time: time
signals:
  rotor_speed: {fields: [rpm], rotor: rotor, unit: rpm}
  command: {fields: [pwm_1, pwm_2, pwm_3, pwm_4], unit: pwm_us}
"""


def to_frame(bag: Path) -> Any:
    """Return a shipped bag as one table, a row for every stamp, most cells of it empty."""
    import pandas as pd  # noqa: PLC0415

    parts = []
    for topic, column in columns_of(bag, {t: list(f) for t, f in LAB.items()}).items():
        part = pd.DataFrame(column.values, columns=list(LAB[topic].values()))
        part.insert(0, "time", column.time)
        if topic == "/mavros/rpm":
            part["rotor"] = 0.0
        parts.append(part)
    return pd.concat(parts).sort_values("time", kind="stable").reset_index(drop=True)


def to_csv(bag: Path, path: Path) -> Path:
    """Write a shipped bag as CSV, times in seconds with all their digits."""
    frame = to_frame(bag)
    frame["time"] = [f"{t // 1_000_000_000}.{t % 1_000_000_000:09d}" for t in frame["time"]]
    frame.to_csv(path, index=False)
    return path


# ULog ------------------------------------------------------------------------------------------

#: Message of a PX4 log -> its format behind the timestamp.
ULOG_FORMATS = {
    "vehicle_local_position": "double x;double y;double z;double vx;double vy;double vz;",
    "vehicle_attitude": "double[4] q;",
    "vehicle_angular_velocity": "double[3] xyz;",
    "vehicle_acceleration": "double[3] xyz;",
    "actuator_outputs": "double[4] output;",
    "esc_status": "esc_report[4] esc;",
    "vehicle_rates_setpoint": "double roll;double pitch;double yaw;double[3] thrust_body;",
    "trajectory_setpoint": "double[3] position;double[3] velocity;double[3] acceleration;",
    "battery_status": "double voltage_v;",
}


def ned(v: np.ndarray) -> np.ndarray:
    """ENU to NED, or back."""
    return np.column_stack([v[:, 1], v[:, 0], -v[:, 2]])


def frd(v: np.ndarray) -> np.ndarray:
    """FLU to FRD, or back."""
    return v * [1.0, -1.0, -1.0]


def ned_frd(q: np.ndarray) -> np.ndarray:
    """Attitude FLU to ENU as attitude FRD to NED: q_ned = t * q * r, by quaternion products."""
    half = np.sqrt(0.5)
    return _product(_product(np.array([[0, half, half, 0]]), q), np.array([[0, 1.0, 0, 0]]))


def _product(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    a, b, c, d = p.T
    w, x, y, z = q.T
    return np.column_stack(
        [
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        ]
    )


def px4_messages(bag: Path) -> dict[str, Column]:
    """Return a shipped bag's signals as PX4's messages in its frames; one rotor turns."""
    columns = columns_of(bag, {t: list(f) for t, f in LAB.items()})
    pose, velocity = columns["/optitrack/pose"], columns["/mavros/local_position/velocity_local"]
    imu, setpoint = columns["/mavros/imu/data"], columns["/mavros/setpoint_raw/attitude"]
    reference = columns["/reference/flatsetpoint"]
    moving = np.column_stack(
        [np.interp(pose.time, velocity.time, column) for column in velocity.values.T]
    )
    rpm = np.full((len(columns["/mavros/rpm"].time), 4), np.nan)
    rpm[:, 0] = columns["/mavros/rpm"].values[:, 0]
    thrust = np.zeros((len(setpoint.time), 3))
    thrust[:, 2] = -setpoint.values[:, 3]
    flat = [ned(reference.values[:, i : i + 3]) for i in (0, 3, 6)]
    return {
        "vehicle_local_position": Column(
            pose.time, np.hstack([ned(pose.values[:, :3]), ned(moving)])
        ),
        "vehicle_attitude": Column(pose.time, ned_frd(pose.values[:, 3:])),
        "vehicle_angular_velocity": Column(imu.time, frd(imu.values[:, :3])),
        "vehicle_acceleration": Column(imu.time, frd(imu.values[:, 3:])),
        "actuator_outputs": columns["/mavros/rc/out"],
        "esc_status": Column(columns["/mavros/rpm"].time, rpm),
        "vehicle_rates_setpoint": Column(
            setpoint.time, np.hstack([frd(setpoint.values[:, :3]), thrust])
        ),
        "trajectory_setpoint": Column(reference.time, np.hstack(flat)),
        "battery_status": columns["/mavros/battery"],
    }


def to_ulog(
    messages: Mapping[str, Column],
    path: Path,
    *,
    boot: int = 0,
    parameters: Mapping[str, float] | None = None,
) -> Path:
    """Write PX4's messages as a log whose clock starts at `boot` ns, and its parameters."""

    def record(kind: str, content: bytes) -> bytes:
        return struct.pack("<HB", len(content), ord(kind)) + content

    out = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0)]
    out.append(record("F", b"esc_report:double esc_rpm;"))
    for name, fields in ULOG_FORMATS.items():
        out.append(record("F", f"{name}:uint64_t timestamp;{fields}".encode()))
    for name, value in (parameters or {}).items():
        whole = isinstance(value, int)
        key = f"{'int32_t' if whole else 'float'} {name}".encode()
        number = struct.pack("<i" if whole else "<f", value)
        out.append(record("P", struct.pack("<B", len(key)) + key + number))
    numbers = {name: i for i, name in enumerate(messages)}
    for name, i in numbers.items():
        out.append(record("A", struct.pack("<BH", 0, i) + name.encode()))
    rows = [
        (int(t - boot) // 1000, numbers[name], row)
        for name, column in messages.items()
        for t, row in zip(column.time, column.values, strict=True)
    ]
    for microseconds, number, row in sorted(rows, key=lambda item: item[0]):
        content = struct.pack(f"<HQ{len(row)}d", number, microseconds, *row)
        out.append(record("D", content))
    path.write_bytes(b"".join(out))
    return path


# PX4 in ROS 2 ----------------------------------------------------------------------------------

_PX4_TYPES = {
    "VehicleOdometry": "uint64 timestamp\nuint64 timestamp_sample\nuint8 pose_frame\n"
    "float64[3] position\nfloat64[4] q\nuint8 velocity_frame\nfloat64[3] velocity\n"
    "float64[3] angular_velocity\n",
    "ActuatorMotors": "uint64 timestamp\nuint64 timestamp_sample\nuint16 reversible_flags\n"
    "float64[4] control\n",
    "VehicleLocalPosition": "uint64 timestamp\nuint64 timestamp_sample\nbool xy_valid\n"
    "float64 x\nfloat64 y\nfloat64 z\nfloat64[2] delta_xy\nfloat64 vx\nfloat64 vy\nfloat64 vz\n",
    "VehicleAttitude": "uint64 timestamp\nuint64 timestamp_sample\nfloat64[4] q\n",
    "VehicleAngularVelocity": "uint64 timestamp\nuint64 timestamp_sample\nfloat64[3] xyz\n",
    "VehicleAcceleration": "uint64 timestamp\nuint64 timestamp_sample\nfloat64[3] xyz\n",
    "ActuatorOutputs": "uint64 timestamp\nuint32 noutputs\nfloat64[4] output\n",
    "EscReport": "float64 esc_rpm\nuint8 esc_address\n",
    "EscStatus": "uint64 timestamp\nuint8 esc_count\npx4_msgs/EscReport[4] esc\n",
    "VehicleRatesSetpoint": "uint64 timestamp\nfloat64 roll\nfloat64 pitch\nfloat64 yaw\n"
    "float64[3] thrust_body\nbool reset_integral\n",
    "TrajectorySetpoint": "uint64 timestamp\nfloat64[3] position\nfloat64[3] velocity\n"
    "float64[3] acceleration\n",
    "BatteryStatus": "uint64 timestamp\nbool connected\nfloat64 voltage_v\n",
}


MOCAP_TYPES = {
    "mocap4r2_msgs/msg/RigidBodies": "std_msgs/Header header\nuint32 frame_number\n"
    "mocap4r2_msgs/RigidBody[] rigidbodies\n",
    "mocap4r2_msgs/msg/RigidBody": "string rigid_body_name\nmocap4r2_msgs/Marker[] markers\n"
    "geometry_msgs/Pose pose\n",
    "mocap4r2_msgs/msg/Marker": "int8 USE_NAME=0\nint8 id_type\nint32 marker_index\n"
    "string marker_name\ngeometry_msgs/Point translation\n",
    "motion_capture_tracking_interfaces/msg/NamedPoseArray": "std_msgs/Header header\n"
    "motion_capture_tracking_interfaces/NamedPose[] poses\n",
    "motion_capture_tracking_interfaces/msg/NamedPose": "string name\ngeometry_msgs/Pose pose\n",
}
#: Driver of a motion capture -> its topic and message type.
MOCAPS = {
    "mocap4r2": ("/rigid_bodies", "mocap4r2_msgs/msg/RigidBodies"),
    "motion_capture_tracking": (
        "/poses",
        "motion_capture_tracking_interfaces/msg/NamedPoseArray",
    ),
    "vrpn_mocap": ("/vrpn_mocap/quad/pose", "geometry_msgs/msg/PoseStamped"),
}


def px4_store() -> Any:
    """Return the message types of PX4's bridge and of motion capture beside it."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    types: dict[str, Any] = {}
    for name, text in _PX4_TYPES.items():
        types.update(get_types_from_msg(text, f"px4_msgs/msg/{name}"))
    for name, text in MOCAP_TYPES.items():
        types.update(get_types_from_msg(text, name))
    store.register(types)
    return store


def mocap_message(store: Any, driver: str, when: int, row: np.ndarray) -> Any:
    """Return a driver's message of a pose: position, then quaternion with w first."""
    t, (topic, kind) = store.types, MOCAPS[driver]
    stamp = t["builtin_interfaces/msg/Time"](*divmod(when, 1_000_000_000))
    header = t["std_msgs/msg/Header"](stamp, "map")
    place = t["geometry_msgs/msg/Point"](*row[:3])
    pose = t["geometry_msgs/msg/Pose"](place, t["geometry_msgs/msg/Quaternion"](*row[4:], row[3]))
    if driver == "mocap4r2":
        marker = t["mocap4r2_msgs/msg/Marker"]
        markers = [marker(0, i, "marker", place) for i in range(3 + when % 2)]
        body = t["mocap4r2_msgs/msg/RigidBody"]("quad", markers, pose)
        return t[kind](header, 7, [body])
    if driver == "motion_capture_tracking":
        named = t["motion_capture_tracking_interfaces/msg/NamedPose"]
        return t[kind](header, [named("quad", pose), named("other", pose)])
    del topic
    return t[kind](header, pose)


def to_px4_ros2(
    messages: Mapping[str, Column],
    folder: Path,
    *,
    boot: int = 0,
    poses: Mapping[str, Column] | None = None,
    storage: StoragePlugin = StoragePlugin.MCAP,
) -> Path:
    """Write PX4's messages as its bridge does, on its clock, and drivers' poses on the host's."""
    store, rows = px4_store(), []
    with Writer(folder, version=9, storage_plugin=storage) as writer:

        def write(topic: str, kind: str, column: Column, make: Callable[..., Any]) -> None:
            connection = writer.add_connection(topic, kind, typestore=store)
            for when, row in zip(column.time, column.values, strict=True):
                content = store.serialize_cdr(make(int(when), row), kind)
                rows.append((int(when), connection, content))

        for name, column in messages.items():
            kind = "px4_msgs/msg/" + "".join(part.title() for part in name.split("_"))
            side = "in" if name == "trajectory_setpoint" else "out"
            write(f"/fmu/{side}/{name}", kind, column, _px4_maker(store, kind, boot))
        for driver, column in (poses or {}).items():
            write(*MOCAPS[driver], column, partial(mocap_message, store, driver))
        for when, connection, content in sorted(rows, key=lambda item: item[0]):
            writer.write(connection, when + 700_000, content)
    return folder


def _px4_maker(store: Any, kind: str, boot: int) -> Callable[[int, np.ndarray], Any]:
    """Return a function that fills a message's float fields in order, its time since boot."""
    fields = store.fielddefs[kind][1]

    def make(when: int, row: np.ndarray) -> Any:
        left = list(row)
        values = []
        for name, (node, detail) in fields:
            if name in ("timestamp", "timestamp_sample"):
                values.append((when - boot) // 1000)
            elif name == "delta_xy":
                values.append(np.zeros(2))
            elif node == Nodetype.BASE and detail[0] == "float64":
                values.append(left.pop(0))
            elif node == Nodetype.BASE:
                values.append(1)
            elif detail[0][0] == Nodetype.NAME:
                report = store.types["px4_msgs/msg/EscReport"]
                values.append([report(left.pop(0), 1) for _ in range(detail[1])])
            else:
                values.append(np.array([left.pop(0) for _ in range(detail[1])]))
        return store.types[kind](*values)

    return make


def without_definitions(folder: Path) -> None:
    """Take the message definitions out of an SQLite recording, as ROS 2 Humble leaves them out."""
    (database,) = folder.glob("*.db3")
    connection = sqlite3.connect(database)
    with connection:
        connection.execute("DROP TABLE IF EXISTS message_definitions")
    connection.close()

"""ROS messages: their definitions, the fields of signals, and decoding into columns.

rosbags decodes message by message, 5 s for the 308,077 messages of a 51 MB bag. The walk here
decodes the wanted fields of all messages of a block at once, to the same bits, in 0.2 s. It goes
through the message's type: numbers of known size, and strings and sequences after their length, in
CDR (ROS 2) with padding to each number's size. All messages of a topic share one walk, with a
cursor each; where all lengths agree, as nearly always, the cursor is a single number.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat, Nodetype
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

from tuner.core.disk import read_bytes
from tuner.core.errors import ConfigError, InputError, RecordingError, short_reason
from tuner.recordings.recording import FieldLayout

#: Fields of a message type in their order: name and rosbags' description of its type.
Fields = list[tuple[str, Any]]

#: The longest true definition is some 20 kB.
MAX_DEFINITION_CHARS = 200_000

#: Types of motion capture's packages, which databases of ROS 2 Humble and before lack.
MOTION_CAPTURE = {
    "mocap4r2_msgs/msg/RigidBodies": (
        "std_msgs/Header header\nuint32 frame_number\nmocap4r2_msgs/RigidBody[] rigidbodies\n"
    ),
    "mocap4r2_msgs/msg/RigidBody": (
        "string rigid_body_name\nmocap4r2_msgs/Marker[] markers\ngeometry_msgs/Pose pose\n"
    ),
    "mocap4r2_msgs/msg/Marker": (
        "int8 id_type\nint32 marker_index\nstring marker_name\ngeometry_msgs/Point translation\n"
    ),
    "motion_capture_tracking_interfaces/msg/NamedPoseArray": (
        "std_msgs/Header header\nmotion_capture_tracking_interfaces/NamedPose[] poses\n"
    ),
    "motion_capture_tracking_interfaces/msg/NamedPose": ("string name\ngeometry_msgs/Pose pose\n"),
}
_XYZ, _WXYZ, _ROTORS = "{x,y,z}", "{w,x,y,z}", "[{0,1,2,3}]"
_layout = FieldLayout.of


@dataclass
class Definitions:
    """The message types of one recording, parsed when they are first asked for.

    Parameters
    ----------
    path
        The recording, named in errors.
    texts
        Message type -> its definition in the recording.
    files
        ``.msg`` files, or folders of them, for types that the recording does not define.
    standard
        Whether types that are nowhere defined are taken from ROS 2's own packages.
    """

    path: Path
    texts: dict[str, MessageDefinition]
    files: tuple[Path, ...] = ()
    standard: bool = False
    _known: dict[str, Fields] = field(default_factory=dict)

    def fields(self, kind: str) -> Fields:
        """Return the fields of a message type.

        Raises
        ------
        RecordingError
            Its definition is missing or cannot be understood.
        """
        if kind not in self._known:
            self._read_definitions(kind)
        return self._known[kind]

    def _read_definitions(self, kind: str) -> None:
        text = self.texts.get(kind)
        if text is not None and text.format is not MessageDefinitionFormat.NONE:
            self._known.update(_parse(self.path, text, kind))
        for given in self.files:
            for path in sorted(given.rglob("*.msg")) if given.is_dir() else [given]:
                self._known = _parse(path, _read(path), _type_of(path)) | self._known
        if self.standard and kind not in self._known and kind in MOTION_CAPTURE:
            text = MessageDefinition(MessageDefinitionFormat.MSG, MOTION_CAPTURE[kind])
            self._known[kind] = _parse(self.path, text, kind)[kind]
        stores = [Stores.EMPTY, Stores.ROS2_HUMBLE] if self.standard else [Stores.EMPTY]
        for store in stores:
            if kind not in self._known and kind in (known := get_typestore(store).fielddefs):
                self._known[kind] = known[kind][1]
        if kind not in self._known:
            raise RecordingError(
                self.path,
                f"the definition of message type {kind} is not in the recording",
                "name its .msg file under 'messages' in the topic map",
            )


def _parse(path: Path, text: MessageDefinition, kind: str) -> dict[str, Fields]:
    if len(text.data) > MAX_DEFINITION_CHARS:
        raise RecordingError(path, f"the definition of {kind} is absurdly long", "leave it out")
    try:
        return _types(text.format, text.data, kind)
    except InputError:
        raise
    except Exception as err:  # the parser has no common error class
        what = f"the definition of {kind} makes no sense ({short_reason(err)})"
        raise RecordingError(path, what, "record it again") from None


@lru_cache(maxsize=64)
def _types(form: MessageDefinitionFormat, text: str, kind: str) -> dict[str, Fields]:
    """Return the fields of the types in a text, cached for further recordings."""
    idl = form is MessageDefinitionFormat.IDL
    types = get_types_from_idl(text) if idl else get_types_from_msg(text, kind)
    return {name: fields for name, (_, fields) in types.items()}


def _type_of(path: Path) -> str:
    """Return the type that a file ``mavros_msgs/msg/RCOut.msg`` defines."""
    package = path.parent.parent.name if path.parent.name == "msg" else path.parent.name
    return f"{package}/msg/{path.stem}"


def _read(path: Path) -> MessageDefinition:
    try:
        text = read_bytes(path, most=MAX_DEFINITION_CHARS, remedy="").decode()
    except (ConfigError, UnicodeDecodeError):
        raise RecordingError(
            path, "cannot be read as a message definition", "name a .msg file"
        ) from None
    return MessageDefinition(MessageDefinitionFormat.MSG, text)


def _pose(prefix: str) -> dict[str, FieldLayout]:
    return {
        "position": _layout(f"{prefix}position.{_XYZ}"),
        "attitude": _layout(f"{prefix}orientation.{_WXYZ}"),
        "reference_position": _layout(f"{prefix}position.{_XYZ}"),
    }


def _twist(prefix: str) -> dict[str, FieldLayout]:
    return {
        "velocity": _layout(f"{prefix}linear.{_XYZ}"),
        "body_rate": _layout(f"{prefix}angular.{_XYZ}"),
        "reference_velocity": _layout(f"{prefix}linear.{_XYZ}"),
    }


_TRANSFORM = {
    "position": _layout(f"transform.translation.{_XYZ}"),
    "attitude": _layout(f"transform.rotation.{_WXYZ}"),
}
_FIRST_BODY = _pose("rigidbodies[0].pose.")
_VECTOR = {
    "velocity": _layout(f"vector.{_XYZ}"),
    "body_rate": _layout(f"vector.{_XYZ}"),
    "acceleration": _layout(f"vector.{_XYZ}"),
}

#: Message type -> signal -> its fields, in the order of the signal's columns. The axes of a twist,
#: world or body, depend on the topic and are checked against the motion.
FIELD_LAYOUTS: Mapping[str, Mapping[str, FieldLayout]] = {
    "geometry_msgs/msg/PoseStamped": _pose("pose."),
    "geometry_msgs/msg/PoseWithCovarianceStamped": _pose("pose.pose."),
    "geometry_msgs/msg/TransformStamped": _TRANSFORM,
    "geometry_msgs/msg/TwistStamped": _twist("twist."),
    "geometry_msgs/msg/TwistWithCovarianceStamped": _twist("twist.twist."),
    "geometry_msgs/msg/Vector3Stamped": _VECTOR,
    "geometry_msgs/msg/AccelStamped": {"acceleration": _layout(f"accel.linear.{_XYZ}")},
    # of several rigid bodies the first; a topic map names another
    "mocap4r2_msgs/msg/RigidBodies": _FIRST_BODY,
    "mocap_msgs/msg/RigidBodies": _FIRST_BODY,
    "motion_capture_tracking_interfaces/msg/NamedPoseArray": _pose("poses[0].pose."),
    "nav_msgs/msg/Odometry": {**_pose("pose.pose."), **_twist("twist.twist.")},
    "sensor_msgs/msg/Imu": {
        "attitude": _layout(f"orientation.{_WXYZ}"),
        "body_rate": _layout(f"angular_velocity.{_XYZ}"),
        "acceleration": _layout(f"linear_acceleration.{_XYZ}"),
    },
    "gazebo_msgs/msg/LinkState": {**_pose("pose."), **_twist("twist.")},
    "gazebo_msgs/msg/ModelState": {**_pose("pose."), **_twist("twist.")},
    "mavros_msgs/msg/RCOut": {"command": _layout(f"channels{_ROTORS}", unit="pwm_us")},
    "mavros_msgs/msg/ESCStatus": {"rotor_speed": _layout(f"esc_status{_ROTORS}.rpm", unit="rpm")},
    "mavros_msgs/msg/ESCTelemetry": {
        "rotor_speed": _layout(f"esc_telemetry{_ROTORS}.rpm", unit="rpm")
    },
    "mavros_msgs/msg/AttitudeTarget": {
        "attitude_setpoint": _layout(f"orientation.{_WXYZ}"),
        "rate_setpoint": _layout(f"body_rate.{_XYZ}"),
        "thrust_setpoint": _layout("thrust"),
    },
    "mavros_msgs/msg/PositionTarget": {
        "reference_position": _layout(f"position.{_XYZ}"),
        "reference_velocity": _layout(f"velocity.{_XYZ}"),
        "reference_acceleration": _layout(f"acceleration_or_force.{_XYZ}"),
    },
    "mav_msgs/msg/Actuators": {
        "rotor_speed": _layout(f"angular_velocities{_ROTORS}"),
        "command": _layout(f"normalized{_ROTORS}"),
    },
    "actuator_msgs/msg/Actuators": {
        "rotor_speed": _layout(f"velocity{_ROTORS}"),
        "command": _layout(f"normalized{_ROTORS}"),
    },
    "controller_msgs/msg/FlatTarget": {
        "reference_position": _layout(f"position.{_XYZ}"),
        "reference_velocity": _layout(f"velocity.{_XYZ}"),
        "reference_acceleration": _layout(f"acceleration.{_XYZ}"),
    },
    "sensor_msgs/msg/BatteryState": {"battery_voltage": _layout("voltage")},
    "std_msgs/msg/Int32": {"lap": _layout("data")},
    "std_msgs/msg/UInt32": {"lap": _layout("data")},
}


Bytes = NDArray[np.uint8]
Index = NDArray[np.int64]
Cursor = int | Index

#: Types nest no deeper, and no array before a wanted field holds more structures.
MAX_DEPTH = 12
MAX_ELEMENTS = 256

_NUMPY_KINDS = dict.fromkeys(("bool", "byte", "char", "octet"), "u1") | {
    f"{name}{8 * size}": f"{name[0]}{size}"
    for name, sizes in (("int", (1, 2, 4, 8)), ("uint", (1, 2, 4, 8)), ("float", (4, 8)))
    for size in sizes
}


@dataclass(frozen=True)
class MessageBlock:
    """Messages of one connection that lie in one buffer.

    Attributes
    ----------
    start, end
        (n,) positions in the buffer at which each message's payload begins and ends.
    time
        (n,) ns, their times of recording.
    """

    buffer: Bytes
    start: Index
    end: Index
    time: Index


def missing_fields(definitions: Definitions, kind: str, fields: Sequence[str]) -> tuple[str, ...]:
    """Return the fields that messages of a type do not have, or that cannot be reached.

    It walks through the type without messages.

    Raises
    ------
    RecordingError
        The definition of the type is missing or cannot be understood.
    """
    nothing, empty = np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.uint8)
    walker = _Walker(definitions, set(fields), empty, np.ones(0, dtype=np.bool_))
    walker.walk((Nodetype.NAME, kind), "", _MessageSpans(nothing, nothing, nothing), 0, 0)
    return tuple(path for path in dict.fromkeys(fields) if path in walker.wanted)


def decode(
    definitions: Definitions,
    kind: str,
    fields: Sequence[str],
    block: MessageBlock,
    *,
    aligned: bool,
) -> tuple[dict[str, NDArray[Any]], NDArray[np.bool_]]:
    """Return the wanted fields of a block's messages, (n,) each, and which messages were whole.

    Numbers keep their type; elements of sequences become floats, NaN where the sequence is too
    short. A message that ends before its last wanted field is not whole; its numbers are invalid.

    Parameters
    ----------
    fields
        Paths that are not `missing_fields`.
    aligned
        Whether numbers are padded to their size, as in CDR.
    """
    count = len(block.start)
    whole, little, head = np.ones(count, dtype=np.bool_), np.ones(count, dtype=np.uint8), 0
    if aligned:  # CDR: four bytes before the payload give the byte order, and do not count
        head = 4
        whole = (block.end - block.start >= head) & (block.start >= 0)
        whole &= block.end <= len(block.buffer)
        little[whole] = block.buffer[block.start[whole] + 1]
        whole &= little <= 1
    columns: dict[str, NDArray[Any]] = {}
    for order, flag in (("<", 1), (">", 0)):
        rows = np.flatnonzero(whole & (little == flag))
        if len(rows) == 0:
            continue
        every = np.ones(len(rows), dtype=np.bool_)
        walker = _Walker(definitions, set(fields), block.buffer, every, order, aligned)
        messages = _MessageSpans(block.start[rows] + head, block.end[rows], np.arange(len(rows)))
        walker.walk((Nodetype.NAME, kind), "", messages, 0, 0)
        whole[rows] = walker.whole
        for name, values in walker.columns.items():
            native = values.astype(values.dtype.newbyteorder("="), copy=False)
            columns.setdefault(name, np.zeros(count, dtype=native.dtype))[rows] = native
    return {name: columns.get(name, np.full(count, np.nan)) for name in fields}, whole


@dataclass(frozen=True)
class _MessageSpans:
    """Start, end and row of some messages in a buffer; (n,) each."""

    start: Index
    end: Index
    rows: Index

    def of(self, which: NDArray[Any]) -> _MessageSpans:
        """Return some of them."""
        return _MessageSpans(self.start[which], self.end[which], self.rows[which])


@dataclass
class _Walker:
    """Walks all messages of a buffer at once, up to the last wanted field.

    Attributes
    ----------
    wanted
        Paths that are not reached yet.
    whole
        (n,) whether a message holds all fields so far.
    order
        Of bytes, in NumPy's code.
    columns
        Path -> (n,) numbers.
    steps_left
        Values left to visit: nested types may multiply.
    """

    definitions: Definitions
    wanted: set[str]
    buffer: Bytes
    whole: NDArray[np.bool_]
    order: str = "<"
    aligned: bool = False
    columns: dict[str, NDArray[Any]] = field(default_factory=dict)
    steps_left: int = 100_000

    def walk(self, what: Any, path: str, of: _MessageSpans, cursor: Cursor, depth: int) -> Cursor:
        """Walk through one value at an offset from the messages' starts; return the next offset.

        Parameters
        ----------
        what
            rosbags' description of the value.
        """
        self.steps_left -= 1
        node, detail = what
        element = what if node in (Nodetype.BASE, Nodetype.NAME) else detail[0]
        text = element[0] == Nodetype.BASE and element[1][0] == "string"
        if self.steps_left < 0 or depth > MAX_DEPTH:
            self._stop(of)
        elif node == Nodetype.NAME:
            for name, inner in self.definitions.fields(detail):
                if not self.wanted:
                    break
                cursor = self.walk(inner, f"{path}.{name}" if path else name, of, cursor, depth + 1)
        elif node == Nodetype.BASE and text:
            cursor = self._sequence("u1", "", of, cursor)
        elif node == Nodetype.ARRAY and (text or element[0] != Nodetype.BASE):
            if detail[1] > MAX_ELEMENTS:
                self._stop(of)
            for i in range(min(detail[1], MAX_ELEMENTS)):
                cursor = self.walk(element, f"{path}[{i}]", of, cursor, depth + 1)
        elif text or element[0] != Nodetype.BASE:
            cursor = self._structures(element, path, of, cursor, depth)
        elif (kind := _NUMPY_KINDS.get(element[1][0])) is None:
            self._stop(of)
        elif node == Nodetype.SEQUENCE:
            cursor = self._sequence(kind, path, of, cursor)
        else:
            inside = {i: f"{path}[{i}]" for i in self._indices(path)}
            names = {0: path} if node == Nodetype.BASE else inside
            cursor = self._numbers(
                kind, names, 1 if node == Nodetype.BASE else detail[1], of, cursor
            )
        return cursor

    def _stop(self, of: _MessageSpans) -> None:
        """Stop the walk at a part of the type that cannot be visited."""
        self.steps_left = 0
        self.whole[of.rows] = False

    def _numbers(
        self, kind: str, names: Mapping[int, str], count: int, of: _MessageSpans, cursor: Cursor
    ) -> Cursor:
        """Walk through numbers of one kind; ``names`` maps positions among them to paths."""
        size = int(kind[1])
        cursor = self._align(cursor, size)
        for position, path in names.items():
            if path in self.wanted and position < count:
                at = of.start + (cursor + position * size)
                self._put(path, self._take(at, of.end, kind, of.rows), of)
        return cursor + count * size

    def _sequence(self, kind: str, path: str, of: _MessageSpans, cursor: Cursor) -> Cursor:
        """Walk through a sequence of numbers after its count; a string is one of bytes."""
        count, cursor = self._length(of, cursor)
        size = int(kind[1])
        # An empty sequence is not padded.
        padded = self._align(cursor, size)
        if np.all(count > 0):
            cursor = padded
        elif np.any(count > 0):
            cursor = np.where(count > 0, padded, cursor)
        for position in self._indices(path):
            has = count > position
            values = np.full(len(of.rows), np.nan)
            at = (of.start + cursor + position * size)[has]
            values[has] = self._take(at, of.end[has], kind, of.rows[has])
            self._put(f"{path}[{position}]", values, of)
        return self._advance(cursor, count * size, of)

    def _structures(
        self, element: Any, path: str, of: _MessageSpans, cursor: Cursor, depth: int
    ) -> Cursor:
        """Walk through a sequence of structures or strings after its count."""
        counts, cursor = self._length(of, cursor)
        at = np.zeros(len(of.rows), dtype=np.int64) + cursor
        # Each element takes at least a byte, and the walk visits at most MAX_ELEMENTS.
        absurd = counts > np.minimum(of.end - of.start - at, MAX_ELEMENTS)
        self.whole[of.rows[absurd]] = False
        counts = np.where(absurd, 0, counts)
        reach = min(max(self._indices(path), default=-1) + 1, MAX_ELEMENTS)
        for i in range(max(int(counts.max(initial=0)), reach)):
            has = np.flatnonzero(counts > i)
            at[has] = self.walk(element, f"{path}[{i}]", of.of(has), at[has], depth + 1)
        return at

    def _indices(self, path: str) -> list[int]:
        """Return the elements of an array that wanted paths lead to or through."""
        names = (name[len(path) + 1 :] for name in self.wanted if name.startswith(f"{path}["))
        digits = {name.partition("]")[0] for name in names}
        return sorted(int(index) for index in digits if index.isdecimal() and len(index) < 6)

    def _length(self, of: _MessageSpans, cursor: Cursor) -> tuple[Index, Cursor]:
        cursor = self._align(cursor, 4)
        length = self._take(of.start + cursor, of.end, "u4", of.rows).astype(np.int64)
        return length, cursor + 4

    def _advance(self, cursor: Cursor, by: Index, of: _MessageSpans) -> Cursor:
        """Move the cursor on by lengths from the file; it stays one number if all agree."""
        if len(by) == 0:
            return cursor
        beyond = of.start + cursor + by > of.end
        if beyond.any():
            self.whole[of.rows[beyond]] = False
            by = np.where(beyond, 0, by)
        if isinstance(cursor, int) and by.min() == by.max():
            return cursor + int(by[0])
        return np.asarray(cursor + by, dtype=np.int64)

    def _align(self, cursor: Cursor, size: int) -> Cursor:
        if not self.aligned or size == 1:
            return cursor
        return (cursor + size - 1) // size * size

    def _take(self, at: Index, end: Index, kind: str, rows: Index) -> NDArray[Any]:
        """Read one number of each message; a message that ends before it is not whole."""
        size = int(kind[1])
        inside = (at >= 0) & (at + size <= end) & (at + size <= len(self.buffer))
        if not inside.all():
            self.whole[rows[~inside]] = False
            at = np.where(inside, at, 0)
        if len(self.buffer) < size:
            return np.zeros(len(at), dtype=self.order + kind)
        spread = self.buffer[at[:, None] + np.arange(size)]
        return np.asarray(spread.view(self.order + kind)[:, 0])

    def _put(self, path: str, values: NDArray[Any], of: _MessageSpans) -> None:
        self.wanted.discard(path)
        if len(of.rows) == len(self.whole):
            self.columns[path] = values
        else:
            empty = np.full(len(self.whole), np.nan)
            self.columns.setdefault(path, empty)[of.rows] = values

"""ROS message types: their definitions, and where well-known ones hold the signals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

from tuner.core.errors import InputError, RecordingError
from tuner.recordings.recording import Usual, reason_of

#: Fields of a message type in their order: name and rosbags' description of what it holds.
Fields = list[tuple[str, Any]]

#: The longest honest definition is some 20 kB; beyond this a parser is only kept busy.
LONGEST = 200_000

#: Types of motion capture's own packages, which databases of ROS 2 Humble and before do not carry.
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
_XYZ = ("x", "y", "z")
_WXYZ = ("w", "x", "y", "z")


@dataclass
class Definitions:
    """The message types of one recording, parsed when they are first asked for.

    Parameters
    ----------
    path
        The recording, named in errors.
    texts
        Message type -> definition as the recording carries it.
    files
        ``.msg`` files, or folders of them, for types that the recording does not carry.
    standard
        Whether types that are nowhere defined may be taken from ROS 2's own packages.
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
            self._learn(kind)
        return self._known[kind]

    def _learn(self, kind: str) -> None:
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
    if len(text.data) > LONGEST:
        raise RecordingError(path, f"the definition of {kind} is absurdly long", "leave it out")
    try:
        return _types(text.format, text.data, kind)
    except InputError:
        raise
    except Exception as err:  # the parser meets hostile text and has no common error class
        what = f"the definition of {kind} makes no sense ({reason_of(err)})"
        raise RecordingError(path, what, "record it again") from None


@lru_cache(maxsize=64)
def _types(form: MessageDefinitionFormat, text: str, kind: str) -> dict[str, Fields]:
    """Return the fields of the types in a text; recordings of a day have the same ones."""
    idl = form is MessageDefinitionFormat.IDL
    types = get_types_from_idl(text) if idl else get_types_from_msg(text, kind)
    return {name: fields for name, (_, fields) in types.items()}


def _type_of(path: Path) -> str:
    """Return the type that a file ``mavros_msgs/msg/RCOut.msg`` defines."""
    package = path.parent.parent.name if path.parent.name == "msg" else path.parent.name
    return f"{package}/msg/{path.stem}"


def _read(path: Path) -> MessageDefinition:
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        raise RecordingError(
            path, "cannot be read as a message definition", "name a .msg file"
        ) from None
    return MessageDefinition(MessageDefinitionFormat.MSG, text)


def _of(prefix: str, fields: tuple[str, ...] = _XYZ) -> Usual:
    return Usual(tuple(f"{prefix}.{name}" for name in fields))


def _pose(prefix: str) -> dict[str, Usual]:
    return {
        "position": _of(f"{prefix}position"),
        "attitude": _of(f"{prefix}orientation", _WXYZ),
        "reference_position": _of(f"{prefix}position"),
    }


def _twist(prefix: str) -> dict[str, Usual]:
    return {
        "velocity": _of(f"{prefix}linear"),
        "body_rate": _of(f"{prefix}angular"),
        "reference_velocity": _of(f"{prefix}linear"),
    }


_TRANSFORM = {
    "position": _of("transform.translation"),
    "attitude": _of("transform.rotation", _WXYZ),
}
_FIRST_BODY = _pose("rigidbodies[0].pose.")
_VECTOR = {"velocity": _of("vector"), "body_rate": _of("vector"), "acceleration": _of("vector")}

#: Message type -> signal -> where it is, fields in the order of the signal's columns. Whether a
#: twist is written in world or body axes depends on the topic: it is checked against the motion.
USUAL: Mapping[str, Mapping[str, Usual]] = {
    "geometry_msgs/msg/PoseStamped": _pose("pose."),
    "geometry_msgs/msg/PoseWithCovarianceStamped": _pose("pose.pose."),
    "geometry_msgs/msg/TransformStamped": _TRANSFORM,
    "geometry_msgs/msg/TwistStamped": _twist("twist."),
    "geometry_msgs/msg/TwistWithCovarianceStamped": _twist("twist.twist."),
    "geometry_msgs/msg/Vector3Stamped": _VECTOR,
    "geometry_msgs/msg/AccelStamped": {"acceleration": _of("accel.linear")},
    # of several rigid bodies the first; a topic map names another
    "mocap4r2_msgs/msg/RigidBodies": _FIRST_BODY,
    "mocap_msgs/msg/RigidBodies": _FIRST_BODY,
    "motion_capture_tracking_interfaces/msg/NamedPoseArray": _pose("poses[0].pose."),
    "nav_msgs/msg/Odometry": {**_pose("pose.pose."), **_twist("twist.twist.")},
    "sensor_msgs/msg/Imu": {
        "attitude": _of("orientation", _WXYZ),
        "body_rate": _of("angular_velocity"),
        "acceleration": _of("linear_acceleration"),
    },
    "gazebo_msgs/msg/LinkState": {**_pose("pose."), **_twist("twist.")},
    "gazebo_msgs/msg/ModelState": {**_pose("pose."), **_twist("twist.")},
    "mavros_msgs/msg/RCOut": {
        "command": Usual(tuple(f"channels[{rotor}]" for rotor in range(4)), unit="pwm_us"),
    },
    "mavros_msgs/msg/ESCStatus": {
        "rotor_speed": Usual(tuple(f"esc_status[{r}].rpm" for r in range(4)), unit="rpm"),
    },
    "mavros_msgs/msg/ESCTelemetry": {
        "rotor_speed": Usual(tuple(f"esc_telemetry[{r}].rpm" for r in range(4)), unit="rpm"),
    },
    "mavros_msgs/msg/AttitudeTarget": {
        "attitude_setpoint": _of("orientation", _WXYZ),
        "rate_setpoint": _of("body_rate"),
        "thrust_setpoint": Usual(("thrust",)),
    },
    "mavros_msgs/msg/PositionTarget": {
        "reference_position": _of("position"),
        "reference_velocity": _of("velocity"),
        "reference_acceleration": _of("acceleration_or_force"),
    },
    "mav_msgs/msg/Actuators": {
        "rotor_speed": Usual(tuple(f"angular_velocities[{rotor}]" for rotor in range(4))),
        "command": Usual(tuple(f"normalized[{rotor}]" for rotor in range(4))),
    },
    "actuator_msgs/msg/Actuators": {
        "rotor_speed": Usual(tuple(f"velocity[{rotor}]" for rotor in range(4))),
        "command": Usual(tuple(f"normalized[{rotor}]" for rotor in range(4))),
    },
    "controller_msgs/msg/FlatTarget": {
        "reference_position": _of("position"),
        "reference_velocity": _of("velocity"),
        "reference_acceleration": _of("acceleration"),
    },
    "sensor_msgs/msg/BatteryState": {"battery_voltage": Usual(("voltage",))},
    "std_msgs/msg/Int32": {"lap": Usual(("data",))},
    "std_msgs/msg/UInt32": {"lap": Usual(("data",))},
}

"""What well-known ROS messages hold: message type and signal to the fields that carry it."""

from __future__ import annotations

from collections.abc import Mapping

from tuner.recordings.recording import Usual

_XYZ = ("x", "y", "z")
_WXYZ = ("w", "x", "y", "z")


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

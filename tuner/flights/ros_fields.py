"""What well-known ROS messages hold: message type and signal to the fields that carry it."""

from __future__ import annotations

from collections.abc import Mapping

from tuner.flights.recording import Usual

_POSITION = ("position.x", "position.y", "position.z")
_ORIENTATION = ("orientation.w", "orientation.x", "orientation.y", "orientation.z")
_XYZ = ("x", "y", "z")


def _under(prefix: str, fields: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(f"{prefix}.{name}" for name in fields)


#: Message type -> signal -> where it is, fields in the order of the signal's columns.
USUAL: Mapping[str, Mapping[str, Usual]] = {
    "geometry_msgs/msg/PoseStamped": {
        "position": Usual(_under("pose", _POSITION)),
        "attitude": Usual(_under("pose", _ORIENTATION)),
        "reference_position": Usual(_under("pose", _POSITION)),
    },
    "geometry_msgs/msg/TwistStamped": {
        "velocity": Usual(_under("twist.linear", _XYZ)),
        "body_rate": Usual(_under("twist.angular", _XYZ)),
        "reference_velocity": Usual(_under("twist.linear", _XYZ)),
    },
    "sensor_msgs/msg/Imu": {
        "attitude": Usual(_ORIENTATION),
        "body_rate": Usual(_under("angular_velocity", _XYZ)),
        "acceleration": Usual(_under("linear_acceleration", _XYZ)),
    },
    "mavros_msgs/msg/RCOut": {
        "command": Usual(tuple(f"channels[{rotor}]" for rotor in range(4)), unit="pwm_us"),
    },
    "mavros_msgs/msg/AttitudeTarget": {
        "rate_setpoint": Usual(_under("body_rate", _XYZ)),
        "thrust_setpoint": Usual(("thrust",)),
    },
    "controller_msgs/msg/FlatTarget": {
        "reference_position": Usual(_under("position", _XYZ)),
        "reference_velocity": Usual(_under("velocity", _XYZ)),
        "reference_acceleration": Usual(_under("acceleration", _XYZ)),
    },
    "sensor_msgs/msg/BatteryState": {"battery_voltage": Usual(("voltage",))},
    "std_msgs/msg/Int32": {"lap": Usual(("data",))},
}

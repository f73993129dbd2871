"""Where PX4's messages hold the signals, alike in its logs and in ROS 2; axes are NED and FRD."""

from __future__ import annotations

import re
from collections.abc import Mapping

from tuner.recordings.recording import Usual


def _fields(*names: str, unit: str = "si") -> Usual:
    return Usual(names, unit, "ned_frd")


def _array(name: str, *, count: int = 3, unit: str = "si") -> Usual:
    return _fields(*(f"{name}[{i}]" for i in range(count)), unit=unit)


_LOCAL_POSITION = {"position": _fields("x", "y", "z"), "velocity": _fields("vx", "vy", "vz")}
_ATTITUDE = {"attitude": _array("q", count=4)}
_ODOMETRY = {
    "position": _array("position"),
    "attitude": _array("q", count=4),
    "velocity": _array("velocity"),
    "body_rate": _array("angular_velocity"),
}

#: Message, named as in a log -> signal -> where it is.
USUAL: Mapping[str, Mapping[str, Usual]] = {
    "vehicle_local_position": _LOCAL_POSITION,
    "vehicle_local_position_groundtruth": _LOCAL_POSITION,
    "vehicle_attitude": _ATTITUDE,
    "vehicle_attitude_groundtruth": _ATTITUDE,
    "vehicle_odometry": _ODOMETRY,
    "vehicle_visual_odometry": _ODOMETRY,
    "vehicle_mocap_odometry": _ODOMETRY,
    "vehicle_angular_velocity": {"body_rate": _array("xyz")},
    "vehicle_acceleration": {"acceleration": _array("xyz")},
    "sensor_combined": {
        "body_rate": _array("gyro_rad"),
        "acceleration": _array("accelerometer_m_s2"),
    },
    "actuator_motors": {"command": _array("control", count=4)},
    "actuator_outputs": {"command": _array("output", count=4, unit="pwm_us")},
    "esc_status": {
        "rotor_speed": _fields(*(f"esc[{i}].esc_rpm" for i in range(4)), unit="rpm"),
    },
    "vehicle_rates_setpoint": {
        "rate_setpoint": _fields("roll", "pitch", "yaw"),
        "thrust_setpoint": _fields("thrust_body[2]"),
    },
    "vehicle_attitude_setpoint": {
        "attitude_setpoint": _array("q_d", count=4),
        "thrust_setpoint": _fields("thrust_body[2]"),
    },
    "trajectory_setpoint": {
        "reference_position": _array("position"),
        "reference_velocity": _array("velocity"),
        "reference_acceleration": _array("acceleration"),
    },
    "vehicle_local_position_setpoint": {
        "reference_position": _fields("x", "y", "z"),
        "reference_velocity": _fields("vx", "vy", "vz"),
        "reference_acceleration": _array("acceleration"),
    },
    "battery_status": {"battery_voltage": _fields("voltage_v")},
}


def log_name(ros_type: str) -> str:
    """Return the name in a log of ``px4_msgs/msg/VehicleLocalPosition``."""
    return re.sub(r"(?<!^)(?=[A-Z])", "_", ros_type.rpartition("/")[2]).lower()

"""PX4's messages: where they hold the signals, and what a log would have to hold more of.

They are alike in its logs and in ROS 2; axes are NED and FRD. Source of profiles and default rates:
PX4's ``logged_topics.cpp``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from tuner.recordings.recording import Usual

SYSTEM_IDENTIFICATION, HIGH_RATE = 8, 16
"""Bits of ``SDLOG_PROFILE``."""
DEFAULT_PROFILE = 1
ENOUGH = 0.8
"""Share of a wanted rate that is enough."""


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
"""Message, named as in a log -> signal -> where it is."""


@dataclass(frozen=True)
class Wanted:
    """A message that a fit needs.

    Attributes
    ----------
    messages
        Its name, and others that serve as well.
    rate
        Hz that are enough.
    shows
        What it shows.
    profiles
        Bits of ``SDLOG_PROFILE`` of which each logs it at full rate.
    """

    messages: tuple[str, ...]
    rate: float
    shows: str
    profiles: tuple[int, ...] = ()


WANTED = (
    Wanted(
        ("vehicle_angular_velocity", "sensor_combined"),
        200.0,
        "how it turns: inertia and the rotors' lag",
        (SYSTEM_IDENTIFICATION, HIGH_RATE),
    ),
    Wanted(
        ("actuator_motors", "actuator_outputs"),
        200.0,
        "what the motors were asked for: inertia and the rotors' lag",
        (SYSTEM_IDENTIFICATION, HIGH_RATE),
    ),
    Wanted(
        ("vehicle_acceleration", "sensor_combined"),
        200.0,
        "thrust and drag",
        (SYSTEM_IDENTIFICATION,),
    ),
    Wanted(("vehicle_rates_setpoint",), 100.0, "what the rate loop was asked for", (HIGH_RATE,)),
    Wanted(("vehicle_attitude",), 100.0, "the attitude that is compared", (HIGH_RATE,)),
    Wanted(
        ("vehicle_local_position", "vehicle_mocap_odometry", "vehicle_visual_odometry"),
        50.0,
        "position and speed: drag and mass",
    ),
    Wanted(("esc_status",), 100.0, "rotor speeds: the motor constant by itself", (HIGH_RATE,)),
)


@dataclass(frozen=True)
class Advice:
    """What to log more of.

    Attributes
    ----------
    message
        Its name.
    logged, wanted
        Hz; 0 of one that is not there.
    shows
        What it would show.
    """

    message: str
    logged: float
    wanted: float
    shows: str


def advice_of(rates: Mapping[str, float]) -> tuple[Advice, ...]:
    """Return which messages are missing, or too slow.

    Parameters
    ----------
    rates
        Message -> Hz at which it was logged.
    """
    found = []
    for wanted in WANTED:
        fastest = max(wanted.messages, key=lambda name: rates.get(name, 0.0))
        logged = rates.get(fastest, 0.0)
        if logged < ENOUGH * wanted.rate:
            found.append(Advice(wanted.messages[0], logged, wanted.rate, wanted.shows))
    return tuple(found)


def settings_in_words(advice: tuple[Advice, ...], parameters: Mapping[str, float]) -> str:
    """Return which logger settings would log what is advised; empty if nothing is.

    Parameters
    ----------
    advice
        Of `advice_of`.
    parameters
        Of the log.
    """
    if not advice:
        return ""
    profile = round(parameters.get("SDLOG_PROFILE", DEFAULT_PROFILE))
    of_message = {wanted.messages[0]: wanted for wanted in WANTED}
    bits, lines = 0, []
    for each in advice:
        wanted = of_message[each.message]
        fresh = [bit for bit in wanted.profiles if not profile & bit]
        if fresh and not bits & sum(fresh):
            bits |= fresh[-1]
        elif not fresh:
            lines.append(f"{each.message} {1000 / each.wanted:.0f}")
    parts = [f"SDLOG_PROFILE {profile | bits} instead of {profile}"] if bits else []
    if lines:
        listed = ", ".join(f"'{line}'" for line in lines)
        parts.append(f"lines {listed} in etc/logging/logger_topics.txt on the SD card")
    return " and ".join(parts)

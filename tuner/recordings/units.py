"""Recorded numbers into the units, axes and orders of a `Flight`: SI, ENU, FLU, (w, x, y, z)."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from tuner.recordings.flight import Array

#: Unit name in a topic map -> (factor, offset): SI value = factor * recorded + offset.
UNITS: Mapping[str, tuple[float, float]] = {
    "si": (1.0, 0.0),
    "rpm": (math.tau / 60, 0.0),
    "hz": (math.tau, 0.0),
    "deg": (math.pi / 180, 0.0),
    "deg/s": (math.pi / 180, 0.0),
    "g": (9.80665, 0.0),
    "mg": (9.80665e-3, 0.0),
    "mm": (1e-3, 0.0),
    "cm": (1e-2, 0.0),
    "mV": (1e-3, 0.0),
    "percent": (1e-2, 0.0),
    "pwm_us": (1e-3, -1.0),
    "pwm_16bit": (1 / 65535, 0.0),
    "signed": (0.5, 0.5),
}

#: Signals whose vectors are written in world or in body axes.
WORLD = {
    "position",
    "velocity",
    "reference_position",
    "reference_velocity",
    "reference_acceleration",
}
BODY = {"body_rate", "acceleration", "rate_setpoint", "commanded_torque"}
#: Signals that are quaternions.
ATTITUDES = {"attitude", "attitude_setpoint"}


def to_si(values: Array, unit: str) -> Array:
    """Convert recorded numbers of any shape to SI."""
    factor, offset = UNITS[unit]
    return factor * values + offset


def to_enu_flu(values: Array, signal: str) -> Array:
    """Turn (n, k) values of a signal from NED world and FRD body axes to ENU and FLU.

    A quaternion from FRD to NED becomes one from FLU to ENU: the world turns by
    (0, 1, 1, 0)/sqrt(2), the body by (0, 1, 0, 0).
    """
    if signal in WORLD:
        north, east, down = values.T
        return np.column_stack([east, north, -down])
    if signal in BODY:
        forward, right, down = values.T
        return np.column_stack([forward, -right, -down])
    if signal in ATTITUDES:
        w, x, y, z = values.T
        return np.column_stack([w + z, x + y, x - y, w - z]) / math.sqrt(2)
    if signal == "thrust_setpoint":  # PX4's thrust points down
        return -values
    return values


def quaternion_of(angles: Array) -> Array:
    """Return (n, 4) quaternions of (n, 3) roll, pitch and yaw in rad, turned about z, y, then x."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(0.5 * angles.T), np.sin(0.5 * angles.T)
    return np.column_stack(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ]
    )


@dataclass(frozen=True)
class Reading:
    """Another way to read recorded numbers, and its name in a sentence."""

    name: str
    read: Callable[[Array], Array]


def _scalar_last(q: Array) -> Array:
    return q[:, [3, 0, 1, 2]]


def _inverse(q: Array) -> Array:
    return np.asarray(q * np.array([1.0, -1.0, -1.0, -1.0]), dtype=np.float64)


#: How attitudes are recorded that are not (w, x, y, z) from FLU to ENU; the likelier first.
ATTITUDE_READINGS = (
    Reading("scalar-last", _scalar_last),
    Reading("world to body", _inverse),
    Reading("NED and FRD", lambda q: to_enu_flu(q, "attitude")),
    Reading("scalar-last, NED and FRD", lambda q: to_enu_flu(_scalar_last(q), "attitude")),
)

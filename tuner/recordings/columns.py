"""A table's columns by their names: which hold what, in which unit, and why.

Names are taken apart into words: ``pose.position.x [mm]``, ``/vrpn/quad/pose/position/x``,
``posX_mm`` and ``field.pose.position.x`` all say position, x, and some a unit. Only what the words
say is taken; what they leave open is found by physics later, or asked for.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from tuner.recordings.recording import Clock
from tuner.recordings.topics import Source

#: Unit as written -> unit of a topic map.
UNITS_WRITTEN: Mapping[str, str] = {
    "s": "s", "sec": "s", "secs": "s", "seconds": "s", "second": "s",
    "ms": "ms", "msec": "ms", "milliseconds": "ms", "us": "us", "µs": "us", "usec": "us",
    "microseconds": "us", "ns": "ns", "nsec": "ns", "nanoseconds": "ns",
    "m": "si", "m/s": "si", "m/s2": "si", "m/s^2": "si", "m/s²": "si", "m/s/s": "si",
    "rad": "si", "rad/s": "si", "rads": "si", "radians": "si", "v": "si", "volt": "si",
    "volts": "si", "mm": "mm", "mm/s": "mm", "cm": "cm", "cm/s": "cm", "deg": "deg", "°": "deg",
    "degrees": "deg", "deg/s": "deg/s", "°/s": "deg/s", "dps": "deg/s", "degs": "deg/s",
    "g": "g", "gs": "g", "mg": "mg", "mv": "mV", "%": "percent", "percent": "percent",
    "rpm": "rpm", "hz": "hz", "rps": "hz", "1/min": "rpm", "pwm": "pwm_us",
}  # fmt: skip
TIME_UNITS = {"s", "ms", "us", "ns"}

#: Word -> the quantities that it may speak of.
_POSITION = {"position", "pos", "p", "translation", "xyz"}
_ATTITUDE = {"orientation", "quaternion", "quat", "q", "rotation", "attitude", "att", "rot"}
_VELOCITY = {"velocity", "vel", "v", "linear_velocity"}
_RATE = {"gyro", "angular_velocity", "body_rate", "bodyrate", "omega", "angvel", "w", "rate",
         "rates", "gyr", "angular"}  # fmt: skip
_FORCE = {"acc", "accel", "accelerometer", "acceleration", "linear_acceleration", "a", "imu_acc"}
_SPEED = {"rotor_speed", "rpm", "motor_speed", "rotorspeed", "motorspeed", "erpm", "motor_rpm",
          "rotor", "esc_rpm", "mot_speed", "omega_motor"}  # fmt: skip
_COMMAND = {"command", "cmd", "pwm", "motor", "mot", "throttle", "motors", "actuator", "u",
            "control", "output", "channels"}  # fmt: skip
_BATTERY = {"battery_voltage", "vbat", "voltage", "battery", "bat", "batt", "voltage_v"}
_TIME = {"time", "t", "timestamp", "stamp", "time_s", "seconds", "__time", "%time",
         "datetime", "date", "rosbagtimestamp", "clock", "elapsed"}  # fmt: skip
#: Signal -> words that speak of it where its columns are numbered.
_MATRICES = {
    "attitude": _ATTITUDE,
    "position": _POSITION - {"xyz"},
    "velocity": _VELOCITY - {"v"},
    "body_rate": _RATE - {"w", "angular"},
    "acceleration": _FORCE - {"a"},
    "angles": {"euler", "rpy", "angles"},
}
#: Words of what was wanted, filtered or of another body, never what was measured of the vehicle.
_OTHER = {"setpoint", "sp", "ref", "reference", "target", "desired", "des", "cmdvel", "goal",
          "error", "err", "cov", "covariance", "std", "var", "variance", "bias", "raw_adc", "mag",
          "integral", "delta", "temperature", "temp", "current", "goalpose", "noise"}  # fmt: skip
#: Words that only say of what, or by whom.
_BODIES = {"mocap", "vicon", "optitrack", "vrpn", "qualisys", "qtm", "drone", "quad", "uav", "cf",
           "vehicle", "body", "robot", "crazyflie", "pose", "state", "odom", "odometry", "out",
           "signals", "local", "world", "global", "marker", "rigid", "gt", "truth", "ground",
           "log", "sim", "measured", "meas"}  # fmt: skip
_ESTIMATE = {"est", "estimate", "estimated", "kalman", "ekf", "filtered"}


@dataclass(frozen=True)
class Guess:
    """What a column's name says.

    Attributes
    ----------
    signal
        Of `SIGNALS`, or ``time``, or ``angles``: an attitude in roll, pitch and yaw.
    axis
        Which of its columns: ``x``, ``w``, ``roll`` or the number of a rotor from 1; empty where
        there is one only.
    unit
        Of a topic map or of time; None where the name does not say.
    group
        The words before, which the columns of a signal share.
    """

    signal: str
    axis: str
    unit: str | None
    group: str


def split_unit(name: str) -> tuple[str, str | None]:
    """Return a name without the unit behind it, in brackets or a last word, and the unit."""
    match = re.fullmatch(r"(.*?)\s*[\[(]\s*([^\])]*)\s*[\])]", name)
    if match and not match[2].isdecimal():
        unit = UNITS_WRITTEN.get(match[2].strip().lower().replace(" ", "").replace("_", "/"))
        return (match[1].strip(), unit) if unit or not match[2].strip() else (name, None)
    head, _, tail = name.rpartition("_")
    unit = UNITS_WRITTEN.get(tail.lower())
    if head and unit and len(tail) > 1 and tail.lower() not in ("rpm", "pwm", "gs", "rads"):
        return head, unit
    return name, None


def guess(name: str, written: str | None = None) -> Guess | None:
    """Return what a column's name says; None where it says nothing that a flight needs.

    Parameters
    ----------
    name
        As it stands in the table.
    written
        What a row of units says of it.
    """
    bare, unit = split_unit(name)
    if written is not None:
        unit = UNITS_WRITTEN.get(written.strip("[]() ").lower(), unit)
    words = _words(bare)
    if not words or _OTHER & set(words):
        return None
    whole = "_".join(words)
    last = re.split(r"[./]", bare.strip().lower())[-1]
    if whole in _TIME or last in _TIME:
        return Guess("time", "", unit if unit in TIME_UNITS else None, "")
    unit = None if unit in TIME_UNITS - {"s"} else unit
    unit = None if unit == "s" else unit
    if words[-1] in ("roll", "pitch", "yaw") and not (_RATE & set(words[:-1])):
        return Guess("angles", words[-1], unit, "_".join(words[:-1]))
    axis, rest = _axis(words)
    if axis is None:
        if whole in _BATTERY or (words[-1] in ("voltage", "vbat", "v") and _BATTERY & set(words)):
            return Guess("battery_voltage", "", unit, "")
        return None
    return _by_words(axis, rest, unit)


def _by_words(axis: str, rest: list[str], unit: str | None) -> Guess | None:
    """Return the signal that the words before an axis or a rotor's number mean."""
    joined = set(rest) | {"_".join(rest[i : i + 2]) for i in range(len(rest) - 1)}
    signal = _numbered(joined, unit) if axis.isdecimal() else _along(axis, joined)
    if signal is None:
        return None
    if signal == "rotor_speed" and unit is None and any("rpm" in word for word in joined):
        unit = "rpm"
    return Guess(signal, axis, None if signal == "attitude" else unit, "_".join(rest))


def _numbered(words: set[str], unit: str | None) -> str | None:
    """Return the signal of a numbered column."""
    if unit in ("rpm", "hz") or words & _SPEED:
        return "rotor_speed"
    if words & _COMMAND:
        return "command"
    return next((signal for signal, known in _MATRICES.items() if words & known), None)


def _along(axis: str, words: set[str]) -> str | None:
    """Return the signal of a column that is called by an axis."""
    single = {word for word in words if "_" not in word}
    rules = (
        ("attitude", axis == "w" or bool(words & _ATTITUDE)),
        ("body_rate", bool(words & (_RATE - {"angular"})) or {"twist", "angular"} <= words),
        ("acceleration", bool(words & _FORCE)),
        ("velocity", bool(words & (_VELOCITY | {"twist"}))),
        ("position", bool(words & _POSITION) or single <= _ESTIMATE | _BODIES),
    )
    return next((signal for signal, holds in rules if holds), None)


def _words(name: str) -> list[str]:
    """Return a name's words in small letters, without what containers put before them."""
    text = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name.strip())
    text = re.sub(r"\[(\d+)\]", r"_\1", text)
    words = [word for word in re.split(r"[^0-9a-zA-Z%°]+", text.lower()) if word]
    return [word for word in words if word not in ("field", "header", "msg", "data", "value")]


def _axis(words: list[str]) -> tuple[str | None, list[str]]:
    """Return the axis or the rotor's number that a name ends or begins with, and the rest."""
    last = words[-1]
    if last in _ESTIMATE and len(words) > 1:
        axis, rest = _axis(words[:-1])
        return axis, [*rest, last]
    if last in ("w", "x", "y", "z") or (last.isdecimal() and len(last) == 1 and len(words) > 1):
        return last, words[:-1]
    glued = re.fullmatch(r"(q|p|v|a|acc|gyro|w|omega|pos|vel|quat|gyr)_?([wxyz])", last)
    if glued:
        return glued[2], [*words[:-1], glued[1]]
    numbered = re.fullmatch(r"([a-z]+)([1-8])", last)
    if numbered and (numbered[1] in _COMMAND | _SPEED or numbered[1] in ("m", "w")):
        return numbered[2], [
            *words[:-1],
            {"m": "motor", "w": "rotor"}.get(numbered[1], numbered[1]),
        ]
    return None, words


#: Signal -> the axes of its columns, in their order.
AXES: Mapping[str, Sequence[str]] = {
    "position": ("x", "y", "z"),
    "velocity": ("x", "y", "z"),
    "attitude": ("w", "x", "y", "z"),
    "angles": ("roll", "pitch", "yaw"),
    "body_rate": ("x", "y", "z"),
    "acceleration": ("x", "y", "z"),
    "rotor_speed": ("1", "2", "3", "4"),
    "command": ("1", "2", "3", "4"),
    "battery_voltage": ("",),
}


def recognised(
    columns: Sequence[str], units: Mapping[str, str]
) -> tuple[Clock | None, dict[str, Source]]:
    """Return the time, and the signals, that a table's columns hold by their names.

    Parameters
    ----------
    columns
        Their names.
    units
        Column -> unit, of a row of units.
    """
    guesses = {name: g for name in columns if (g := guess(name, units.get(name))) is not None}
    times = [name for name, g in guesses.items() if g.signal == "time"]
    stamps = [name for name in times if name.endswith("header.stamp")]  # rather than of recording
    time = next(iter((*stamps, *times)), None)
    found: dict[str, Source] = {}
    for signal, axes in AXES.items():
        groups: dict[str, dict[str, str]] = {}
        for name, g in guesses.items():
            if g.signal == signal:
                groups.setdefault(g.group, {}).setdefault(g.axis, name)
        for _, held in sorted(groups.items(), key=lambda item: _rank(item[0])):
            count = range(len(axes))
            ways = (axes, [str(i) for i in count], [str(i + 1) for i in count])
            numbers = {axis for axis in held if axis.isdecimal()}
            wanted = next(
                (way for way in ways if set(way) <= set(held) and numbers <= set(way)), None
            )
            if wanted is not None:
                names = tuple(held[axis] for axis in wanted)
                written = {guesses[name].unit for name in names}
                unit = written.pop() if len(written) == 1 else None
                if signal == "angles":
                    angles = Source(fields=names, unit=unit, quaternion="rpy")
                    found.setdefault("attitude", angles)
                else:
                    found[signal] = Source(fields=names, unit=unit)
                break
    known = None if time is None else {"field": time, "unit": guesses[time].unit}
    return None if known is None else Clock.model_validate(known), found


def _rank(group: str) -> tuple[bool, int]:
    """Return the order in which the groups that hold a signal are preferred: measured, short."""
    return bool(_ESTIMATE & set(group.split("_"))), len(group)

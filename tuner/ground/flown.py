"""Flights as ground measurements: the steady part of a hover or a spin, a pendulum's angle."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tuner.core.errors import RecordingError
from tuner.ground.measurement import Array, Curve
from tuner.ground.plateaus import levels_of, without_outliers
from tuner.recordings.content import Content, Settings, given_map, read_content
from tuner.recordings.topics import read_sidecar

SHORTEST = 3.0
"""s of steady flight without which there is no mean."""
STEP = 0.05
"""Change of the mean rotor speed, relative to its median, beyond which flight is not steady."""
TABLES = (".csv", ".tsv", ".txt", ".parquet")
AXES = ("x", "y", "z")
VERTICAL = 0.9
"""Least cosine between the body axis that hangs vertical and the vertical."""


@dataclass(frozen=True)
class SteadyFlight:
    """Means over the longest steady part of a flight.

    Attributes
    ----------
    rotor_speed
        (4,) rad/s in PX4's motor order.
    yaw_rate
        rad/s; NaN where it was not recorded.
    curve
        Shows which samples were used.
    """

    rotor_speed: Array
    yaw_rate: float
    curve: Curve


def is_table(path: Path) -> bool:
    """Return whether a recording is a table by its name, with columns of a rig's."""
    return path.suffix.lower() in TABLES


def attitude_of(path: Path) -> tuple[Array, Array]:
    """Return times (n,) s and attitudes (n, 4) w, x, y, z of any recording that `tune` reads.

    Raises
    ------
    RecordingError
        It cannot be read or holds no pose.
    """
    series = _content(path).series["attitude"]
    return series.time - series.time[0], series.values


def steady_flight(path: Path) -> SteadyFlight:
    """Return the means over the longest steady part of a flight.

    Raises
    ------
    RecordingError
        It cannot be read, lacks rotor speeds, or is never steady.
    """
    series = _content(path).series
    if "rotor_speed" not in series:
        raise RecordingError(path, "has no rotor speeds", "give the point by its numbers")
    time, speeds = series["rotor_speed"].time, series["rotor_speed"].values
    measured = np.isfinite(speeds).any(axis=1)
    time, speeds = time[measured], speeds[measured]
    if len(time) < 20:
        raise RecordingError(path, "has hardly a rotor speed", "give the point by its numbers")
    mean = np.nanmean(speeds, axis=1)
    parts = levels_of(mean, time, shortest=SHORTEST, step=STEP * float(np.median(mean)))
    turning = [part for part in parts if np.median(mean[part.samples]) > 0.5 * mean.max()]
    if not turning:
        what = f"is nowhere steady for {SHORTEST:g} s"
        raise RecordingError(path, what, "hold the hover or the spin longer")
    longest = max(turning, key=lambda part: part.end - part.begin)
    inside = longest.samples
    used = np.zeros(len(time), bool)
    used[inside] = True
    rotors = []
    for column in speeds[inside].T:
        if not np.isfinite(column).any():
            raise RecordingError(path, "lacks a rotor's speed", "give the point by its numbers")
        rotors.append(float(column[without_outliers(column)].mean()))
    yaw_rate = np.nan
    if "body_rate" in series:
        rates = series["body_rate"]
        within = (rates.time >= longest.begin) & (rates.time <= longest.end)
        yaw_rate = float(np.nanmean(rates.values[within, 2])) if within.any() else np.nan
    level = np.array([mean[inside].mean()])
    curve = Curve(
        f"Steady part of {path.name}", "time, s", "mean rotor speed, rad/s", time, mean, used,
        np.array([0.5 * (longest.begin + longest.end)]), level, law=False,
    )  # fmt: skip
    return SteadyFlight(np.array(rotors), yaw_rate, curve)


def _content(path: Path) -> Content:
    if not path.exists():
        raise RecordingError(path, "does not exist", "check the path")
    settings, sidecar = Settings(), read_sidecar(path)
    return read_content(path, settings, sidecar, given_map(path, settings, sidecar))


def angle_of_attitude(path: str, quaternion: Array, axis: str) -> Array:
    """Return the angle (n,), rad, about the vertical, of a body that hangs by one of its axes.

    Parameters
    ----------
    path
        Of the recording.
    quaternion
        (n, 4) w, x, y, z: body to world, world z up; rows that are not finite give NaN.
    axis
        The body axis that ought to hang vertical.

    Raises
    ------
    RecordingError
        Another body axis, or none, hangs vertical.
    """
    norm = np.linalg.norm(quaternion, axis=1, keepdims=True)
    w, x, y, z = (quaternion / np.where(norm > 0.1, norm, np.nan)).T
    up = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)])
    mean = np.nanmean(up, axis=1) if np.isfinite(w).any() else np.zeros(3)
    hanging = int(np.argmax(np.abs(mean)))
    if abs(mean[hanging]) < VERTICAL:
        raise RecordingError(path, "hangs by no body axis", "hang it by the axis to be measured")
    if AXES[hanging] != axis:
        what = f"hangs by its body axis {AXES[hanging]}, and axis says {axis}"
        raise RecordingError(path, what, "correct the axis, or hang it by the other one")
    # the heading of a body axis that lies level tells the turn about the vertical
    level = (hanging + 1) % 3
    columns = (
        (1 - 2 * (y * y + z * z), 2 * (x * y + w * z)),
        (2 * (x * y - w * z), 1 - 2 * (x * x + z * z)),
        (2 * (x * z + w * y), 2 * (y * z - w * x)),
    )
    forward, left = columns[level]
    heading = np.arctan2(left, forward)
    known = np.isfinite(heading)
    angle = np.full(len(heading), np.nan)
    angle[known] = np.unwrap(heading[known])
    return np.asarray(angle - np.nanmean(angle))

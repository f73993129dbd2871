"""Flights as ground measurements: the steady part of a hover or a spin, a pendulum's attitude."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tuner.bench.measurement import Array, Curve
from tuner.bench.plateaus import levels_of, without_outliers
from tuner.errors import RecordingError
from tuner.flights.content import Content, Settings, given_map, read_content
from tuner.flights.sidecar import read_sidecar

SHORTEST = 3.0
"""s of steady flight without which there is no mean."""
STEP = 0.05
"""Change of the mean rotor speed, relative to its median, beyond which flight is not steady."""
TABLES = (".csv", ".tsv", ".txt", ".parquet")


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

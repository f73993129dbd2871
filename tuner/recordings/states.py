"""The vehicle's state at many times of a flight, as a recording of it gives it: filtered samples.

Every signal is read as the parabola through its samples within a few hundredths of a second around
a time (Savitzky and Golay 1964, on stamps that need not be even). That keeps the motion of a small
drone and takes off most of the noise. Velocity, where it was not recorded, is the slope of
position's parabola, and body rate follows from attitude's.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from tuner.recordings.flight import SIGNALS, Array, InitialState, Series
from tuner.recordings.motion import body_rate_from

AROUND = 0.03
"""s on either side of a time from which its state is filtered."""
FEWEST = 3
"""Samples on either side that it is filtered from at least, where they follow each other slowly."""
WITHIN = 0.5
"""s beyond which no sample says anything of a time."""


@dataclass(frozen=True)
class States:
    """Recorded states at n times; NaN where a signal was not recorded around a time.

    Attributes
    ----------
    time
        (n,) s since the mission's start.
    position, velocity, body_rate
        (n, 3) m and m/s, world ENU; rad/s, body FLU.
    attitude
        (n, 4) unit quaternions (w, x, y, z), body to world.
    rotor_speed, command
        (n, 4) rad/s and 0..1.
    """

    time: Array
    position: Array
    velocity: Array
    attitude: Array
    body_rate: Array
    rotor_speed: Array
    command: Array

    def at(self, number: int) -> InitialState:
        """Return one of them."""
        return InitialState(
            position=self.position[number],
            velocity=self.velocity[number],
            attitude=self.attitude[number],
            body_rate=self.body_rate[number],
            rotor_speed=self.rotor_speed[number],
            command=self.command[number],
        )


def states_at(series: Mapping[str, Series], times: Array) -> States:
    """Return the recorded states at some times (n,) in s.

    Parameters
    ----------
    series
        Signal -> its samples; position and attitude among them.
    times
        In s since the mission's start.
    """

    def read(name: str) -> Array:
        if name not in series:
            return np.full((len(times), SIGNALS[name][0]), np.nan)
        return filtered(series[name], times)

    velocity = read("velocity")
    if not np.isfinite(velocity).all():
        slope = filtered(series["position"], times, derivative=1)
        velocity = np.where(np.isfinite(velocity), velocity, slope)
    attitude = read("attitude")
    attitude = attitude / np.linalg.norm(attitude, axis=1, keepdims=True)
    body_rate = read("body_rate")
    if not np.isfinite(body_rate).all():
        turning = filtered(series["attitude"], times, derivative=1)
        body_rate = np.where(np.isfinite(body_rate), body_rate, body_rate_from(attitude, turning))
    return States(
        time=np.asarray(times, float),
        position=read("position"),
        velocity=velocity,
        attitude=attitude,
        body_rate=body_rate,
        rotor_speed=read("rotor_speed"),
        command=read("command"),
    )


def half_width(series: Series) -> float:
    """Return the s on either side of a time from which a signal is filtered."""
    gap = float(np.median(np.diff(series.time))) if len(series.time) > 1 else 0.0
    return max(AROUND, (FEWEST + 0.5) * gap)


def filtered(series: Series, times: Array, *, derivative: int = 0) -> Array:
    """Return a signal's columns (n, k), or their derivatives in 1/s, at some times (n,).

    NaN where fewer than two samples lie around a time.
    """
    columns = []
    half = half_width(series)
    for column in series.values.T:
        known = np.isfinite(column)
        columns.append(_parabolas(series.time[known], column[known], times, half, derivative))
    return np.column_stack(columns)


def _parabolas(time: Array, values: Array, times: Array, half: float, derivative: int) -> Array:
    """Return the parabolas' values, or slopes, at some times; lines where samples are few."""
    if len(time) < 2:
        return np.full(len(times), np.nan)
    first = np.searchsorted(time, times - half - 1e-9)
    behind = np.searchsorted(time, times + half + 1e-9)
    # at the ends of a recording, and in its gaps, the nearest two
    nearest = np.clip(np.searchsorted(time, times) - 1, 0, len(time) - 2)
    few = behind - first < 2
    first, behind = np.where(few, nearest, first), np.where(few, nearest + 2, behind)
    place = first[:, None] + np.arange(int((behind - first).max()))
    weight = (place < behind[:, None]).astype(float)
    place = np.minimum(place, len(time) - 1)
    away = (time[place] - times[:, None]) / half
    count = weight.sum(axis=1)
    powers = np.stack([np.ones_like(away), away, away**2], axis=1)
    matrix = np.einsum("tpi,ti,tqi->tpq", powers, weight, powers)
    right = np.einsum("tpi,ti,ti->tp", powers, weight, values[place])
    line = count < 4
    matrix[line, 2, :], matrix[line, :, 2], matrix[line, 2, 2] = 0.0, 0.0, 1.0
    right[line, 2] = 0.0
    found = np.linalg.solve(matrix, right[..., None])[..., 0]
    near = np.abs(time[place] - times[:, None]).min(axis=1) <= WITHIN
    return np.where(near, found[:, derivative] / half**derivative, np.nan)

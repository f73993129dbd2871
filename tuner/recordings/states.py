"""The vehicle's recorded state at some times of a flight, and at its start.

A signal is filtered by the parabola through its samples within a few hundredths of a second
(Savitzky and Golay 1964, for uneven stamps), which keeps the motion of a small drone and removes
most of the noise. If not recorded, velocity is the slope of position's parabola, and body rate
follows from attitude's. A steady hover before a mission is averaged.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np

from tuner.core.numerics import Array, robust_sd
from tuner.recordings.flight import SIGNALS, InitialState, Series
from tuner.recordings.interpolation import body_rate_from

MIN_HALF_WIDTH_S = 0.03
"""The filter's window reaches at least so far to either side,"""
MIN_SAMPLES_EACH_SIDE = 3
"""and to so many samples of a slow signal."""
MAX_SAMPLE_DISTANCE_S = 0.5
"""A state is unknown if no sample is nearer."""
HOVER_WINDOW_S = 1.0
"""The window before the mission that may be a steady hover."""
HALF_WINDOW_S = 0.1
"""The polynomial of a vehicle in motion takes so much on each side of the start."""
MAX_HOVER_SPEED = 0.05
MAX_HOVER_TURN_RATE = 0.1
"""m/s and rad/s. A hover moves and turns slower."""


@dataclass(frozen=True)
class States(InitialState):
    """Recorded states at n times: `InitialState` with an axis of n before that of every array.

    NaN where a signal was not recorded near a time.

    Attributes
    ----------
    time
        (n,) s since the mission's start.
    """

    time: Array

    def at(self, number: int) -> InitialState:
        """Return one state."""
        names = [field.name for field in fields(InitialState)]
        return InitialState(**{name: getattr(self, name)[number] for name in names})


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
            return np.full((len(times), SIGNALS[name].columns), np.nan)
        return local_parabolas(series[name], times)

    velocity = read("velocity")
    if not np.isfinite(velocity).all():
        slope = local_parabolas(series["position"], times, derivative=1)
        velocity = np.where(np.isfinite(velocity), velocity, slope)
    attitude = read("attitude")
    attitude = attitude / np.linalg.norm(attitude, axis=1, keepdims=True)
    body_rate = read("body_rate")
    if not np.isfinite(body_rate).all():
        turning = local_parabolas(series["attitude"], times, derivative=1)
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
    """Return half the window, in s, of the filter of a signal."""
    gap = float(np.median(np.diff(series.time))) if len(series.time) > 1 else 0.0
    return max(MIN_HALF_WIDTH_S, (MIN_SAMPLES_EACH_SIDE + 0.5) * gap)


def local_parabolas(series: Series, times: Array, *, derivative: int = 0) -> Array:
    """Return a signal's columns (n, k), or their derivatives in 1/s, at some times (n,).

    NaN where fewer than two samples lie around a time.
    """
    half, known = half_width(series), np.isfinite(series.values)
    alike = bool((known == known[:, :1]).all())
    together = [slice(None)] if alike else [slice(c, c + 1) for c in range(known.shape[1])]
    columns = []
    for own in together:
        there = known[:, own].all(axis=1)
        read = series.values[there, own]
        columns.append(_local_parabola(series.time[there], read, times, half, derivative))
    return np.hstack(columns)


def _local_parabola(
    time: Array, values: Array, times: Array, half: float, derivative: int
) -> Array:
    """Return the values (n, k), or slopes, of local parabolas, or of lines through few samples.

    Of samples (m, k), all of them known.
    """
    if len(time) < 2:
        return np.full((len(times), values.shape[1]), np.nan)
    first = np.searchsorted(time, times - half - 1e-9)
    behind = np.searchsorted(time, times + half + 1e-9)
    # at the ends of a recording and in gaps, the nearest two samples
    nearest = np.clip(np.searchsorted(time, times) - 1, 0, len(time) - 2)
    few = behind - first < 2
    first, behind = np.where(few, nearest, first), np.where(few, nearest + 2, behind)
    place = first[:, None] + np.arange(int((behind - first).max()))
    weight = (place < behind[:, None]).astype(float)
    place = np.minimum(place, len(time) - 1)
    away = (time[place] - times[:, None]) / half
    powers = np.cumprod([weight, *[away] * 4], axis=0)
    matrix = powers.sum(axis=2)[np.add.outer(range(3), range(3))]
    right = np.moveaxis(powers[:3], 0, 1) @ values[place]
    matrix, line = np.moveaxis(matrix, 2, 0), behind - first < 4
    matrix[line, 2, :], matrix[line, :, 2], matrix[line, 2, 2] = 0.0, 0.0, 1.0
    right[line, 2] = 0.0
    found = np.linalg.solve(matrix, right)
    near = np.abs(time[place] - times[:, None]).min(axis=1) <= MAX_SAMPLE_DISTANCE_S
    return np.where(near[:, None], found[:, derivative] / half**derivative, np.nan)


def initial_state(series: Mapping[str, Series]) -> InitialState:
    """Estimate the state at time 0.

    The last second of a steady hover is averaged robustly (position by a line, evaluated at 0,
    since a hover may creep); otherwise a parabola is fitted around 0.
    """
    hover = in_hover(series)

    def at_start(name: str, *, line: bool = False) -> Array:
        columns = SIGNALS[name].columns
        if name not in series:
            return np.full(columns, np.nan)
        return np.array([_at_start(series[name], c, hover, line) for c in range(columns)])

    velocity = at_start("velocity")
    if not np.isfinite(velocity).all():
        velocity = np.array([_at_start(series["position"], c, False, True, 1) for c in range(3)])
    attitude = at_start("attitude")
    rate = at_start("body_rate")
    return InitialState(
        position=at_start("position", line=True),
        velocity=velocity,
        attitude=attitude / np.linalg.norm(attitude),
        body_rate=np.where(np.isfinite(rate), rate, 0.0),
        rotor_speed=at_start("rotor_speed"),
        command=at_start("command"),
    )


def initial_position_error(series: Mapping[str, Series], noise: float) -> float:
    """Return the standard error in m of the position (each axis) in `initial_state`.

    It is that of a line's end in a hover, else of a parabola's middle.

    Parameters
    ----------
    noise
        m, standard deviation of a sample.
    """
    hover = in_hover(series)
    count = len(_near_start(series["position"], hover).complete().time)
    return float((2.0 if hover else 1.5) * noise / np.sqrt(max(count, 1)))


def in_hover(series: Mapping[str, Series]) -> bool:
    """Return whether the vehicle hovers through the last second before time 0."""
    position = series["position"].between(-HOVER_WINDOW_S, 0.0)
    if len(position.time) < 5 or position.time[0] > -0.8 * HOVER_WINDOW_S:
        return False
    slope = np.polyfit(position.time, position.values, 1)[0]
    swing = np.quantile(position.values, 0.95, axis=0) - np.quantile(position.values, 0.05, axis=0)
    if np.abs(slope).max() > MAX_HOVER_SPEED or swing.max() > MAX_HOVER_SPEED * HOVER_WINDOW_S:
        return False
    if "body_rate" not in series:
        return True
    rates = series["body_rate"].between(-HOVER_WINDOW_S, 0.0).values
    return len(rates) > 0 and bool(np.abs(np.median(rates, axis=0)).max() < MAX_HOVER_TURN_RATE)


def _near_start(series: Series, hover: bool) -> Series:
    """Return the samples near the start."""
    return (
        series.between(-HOVER_WINDOW_S, 0.0)
        if hover
        else series.between(-HALF_WINDOW_S, HALF_WINDOW_S)
    )


def _at_start(series: Series, column: int, hover: bool, line: bool, derivative: int = 0) -> float:
    """Return one column, or its derivative, at time 0."""
    time, values = _near_start(series, hover).column(column)
    if len(time) == 0:
        return float("nan") if derivative else _nearest_sample(series, column)
    if hover:
        middle = np.median(values)
        spread = robust_sd(values - middle) + 1e-12
        kept = np.abs(values - middle) < 5 * spread
        time, values = time[kept], values[kept]
        if not line or len(time) < 5:
            return float(values.mean())
    if len(time) < 3:
        return float("nan") if derivative else float(values[np.argmin(np.abs(time))])
    degree = 1 if hover or len(time) < 6 else 2
    coefficients = np.polyfit(time, values, degree)
    return float(coefficients[-1 - derivative])


def _nearest_sample(series: Series, column: int) -> float:
    """Return the sample nearest to the start, within half a second; else NaN."""
    time, values = series.column(column)
    away = np.abs(time)
    return float(values[away.argmin()]) if (away < 0.5).any() else float("nan")

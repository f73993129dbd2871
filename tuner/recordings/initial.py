"""The vehicle at the start of the mission, smoothed from the recording around it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tuner.core.numerics import robust_sd
from tuner.recordings.flight import SIGNALS, Array, InitialState, Series

#: Seconds before the mission in which a steady hover is looked for.
HOVER = 1.0
#: Seconds on each side of the start for the polynomial of a vehicle in motion.
AROUND = 0.1
#: A hover moves slower than this, in m/s, and turns slower than this, in rad/s.
SLOW = 0.05
STILL = 0.1


def initial_state(series: Mapping[str, Series]) -> InitialState:
    """Estimate the state at time 0.

    In a steady hover before the start the last second is averaged robustly (position by a line,
    evaluated at 0, since a hover may still creep); otherwise a parabola is fitted around 0.
    """
    hover = in_hover(series)

    def at_start(name: str, *, line: bool = False) -> Array:
        columns = SIGNALS[name][0]
        if name not in series:
            return np.full(columns, np.nan)
        return np.array([_estimate(series[name], c, hover, line) for c in range(columns)])

    velocity = at_start("velocity")
    if not np.isfinite(velocity).all():
        velocity = np.array([_estimate(series["position"], c, False, True, 1) for c in range(3)])
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


def position_error(series: Mapping[str, Series], noise: float) -> float:
    """Return the standard error in m of the position (each axis) in `initial_state`.

    That of the end of a line through samples of a second, or of the middle of a parabola through
    those around the start.

    Parameters
    ----------
    noise
        m, standard deviation of a sample.
    """
    hover = in_hover(series)
    near = _near_start(series["position"], hover)
    count = int(np.isfinite(near.values).all(axis=1).sum())
    return float((2.0 if hover else 1.5) * noise / np.sqrt(max(count, 1)))


def in_hover(series: Mapping[str, Series]) -> bool:
    """Return whether the vehicle hovers through the last second before time 0."""
    position = series["position"].between(-HOVER, 0.0)
    if len(position.time) < 5 or position.time[0] > -0.8 * HOVER:
        return False
    slope = np.polyfit(position.time, position.values, 1)[0]
    swing = np.quantile(position.values, 0.95, axis=0) - np.quantile(position.values, 0.05, axis=0)
    if np.abs(slope).max() > SLOW or swing.max() > SLOW * HOVER:
        return False
    if "body_rate" not in series:
        return True
    rates = series["body_rate"].between(-HOVER, 0.0).values
    return len(rates) > 0 and bool(np.abs(np.median(rates, axis=0)).max() < STILL)


def _near_start(series: Series, hover: bool) -> Series:
    """Return the samples that tell of the start."""
    return series.between(-HOVER, 0.0) if hover else series.between(-AROUND, AROUND)


def _estimate(series: Series, column: int, hover: bool, line: bool, derivative: int = 0) -> float:
    """Return one column, or its derivative, at time 0."""
    near = _near_start(series, hover)
    measured = np.isfinite(near.values[:, column])
    time, values = near.time[measured], near.values[measured, column]
    if len(time) == 0:
        return float("nan") if derivative else _nearest(series, column)
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


def _nearest(series: Series, column: int) -> float:
    """Return the sample nearest to the start, if there is one within half a second."""
    measured = np.flatnonzero(np.isfinite(series.values[:, column]))
    if len(measured) == 0:
        return float("nan")
    best = measured[np.argmin(np.abs(series.time[measured]))]
    return float(series.values[best, column]) if abs(series.time[best]) < 0.5 else float("nan")

"""The mission in a recording: when it starts and ends, and whether it is a yaw spin."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tuner.flights.flight import Series

#: Reference motion below this, in m or m/s, is a reference at rest.
AT_REST = 1e-5


def mission_span(series: Mapping[str, Series]) -> tuple[float, float]:
    """Return start and end of the mission in the time of the series.

    It starts where the attitude set-points begin or, where there are none, where the reference
    starts to move; without either, with the pose. It ends with the last sample of those, or with
    the pose if that ends earlier.
    """
    pose = series["position"].time
    start, end = float(pose[0]), float(pose[-1])
    for name in ("rate_setpoint", "thrust_setpoint"):
        if name in series:
            time = series[name].time
            return max(start, float(time[0])), min(end, float(time[-1]))
    moved = [
        float(series[name].time[index])
        for name in ("reference_position", "reference_velocity")
        if name in series and (index := _first_motion(series[name])) is not None
    ]
    if moved:
        return max(start, min(moved)), min(end, float(series["reference_position"].time[-1]))
    return start, end


def _first_motion(reference: Series) -> int | None:
    moving = np.abs(reference.values - reference.values[0]).max(axis=1) > AT_REST
    return int(np.argmax(moving)) if moving.any() else None


def yaw_spin(rate_setpoint: Series, start: float, end: float) -> float | None:
    """Return the yaw rate, rad/s, of a mission whose rate set-points are one constant yaw rate."""
    during = (rate_setpoint.time >= start - 1e-3) & (rate_setpoint.time <= end)
    if during.sum() < 10:
        return None
    rates = rate_setpoint.values[during]
    yaw = float(np.median(rates[:, 2]))
    level = (np.abs(rates[:, :2]) < 1e-6).all(axis=1)
    constant = np.abs(rates[:, 2] - yaw) < 1e-3 * abs(yaw)
    return yaw if abs(yaw) > 0.05 and float((level & constant).mean()) > 0.95 else None

"""Motion derived from a recording, to hold one signal against another."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tuner.recordings.flight import Array, Series
from tuner.recordings.resample import resample

#: Hz and seconds of the stretch that is looked at.
RATE = 100.0
LONGEST = 60.0


def stretch(series: Mapping[str, Series]) -> Array:
    """Return a uniform clock over the middle of a recording, one minute at most."""
    time = series["position"].time
    start, end = float(time[0]), float(time[-1])
    spare = max(0.0, end - start - LONGEST) / 2
    return np.arange(start + spare, end - spare, 1 / RATE)


def on_clock(series: Mapping[str, Series], name: str, clock: Array) -> Array:
    """Return a signal on a clock, (n, k)."""
    return resample(name, series[name], clock)


def smooth(values: Array, seconds: float = 0.05) -> Array:
    """Return (n, k) values averaged over a window around each; NaN where it is not all known."""
    width = max(1, round(seconds * RATE) | 1)
    result = np.full(values.shape, np.nan)
    if len(values) >= width:
        kernel = np.ones(width) / width
        for column, averaged in zip(values.T, result.T, strict=True):
            averaged[width // 2 : len(values) - width // 2] = np.convolve(column, kernel, "valid")
    return result


def derivative(values: Array) -> Array:
    """Return the derivative in time of (n, k) values on the clock."""
    return np.asarray(np.gradient(values, 1 / RATE, axis=0))


def rotate(q: Array, v: Array) -> Array:
    """Return (n, 3) body vectors in world axes; `q` is (n, 4), w first."""
    w, xyz = q[:, :1], q[:, 1:]
    twice = 2 * np.cross(xyz, v)
    return np.asarray(v + w * twice + np.cross(xyz, twice))


def body_rate_of(q: Array) -> Array:
    """Return the (n, 3) body rate, rad/s, of (n, 4) attitudes on the clock."""
    return body_rate_from(q, derivative(q))


def body_rate_from(q: Array, turning: Array) -> Array:
    """Return the (n, 3) body rate, rad/s, of (n, 4) attitudes that turn so: 2 q* ⊗ dq/dt."""
    w, x, y, z = q.T
    dw, dx, dy, dz = turning.T
    return 2.0 * np.column_stack(
        [
            w * dx - x * dw - y * dz + z * dy,
            w * dy + x * dz - y * dw - z * dx,
            w * dz - x * dy + y * dx - z * dw,
        ]
    )


def alike(a: Array, b: Array) -> float:
    """Return the correlation of two (n, k) signals over all their columns, -1..1."""
    known = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)
    if known.sum() < 20:
        return 0.0
    a, b = a[known] - a[known].mean(axis=0), b[known] - b[known].mean(axis=0)
    size = float(np.sqrt((a * a).sum() * (b * b).sum()))
    return float((a * b).sum() / size) if size > 0 else 0.0


def rms(values: Array) -> float:
    """Return the root mean square length of (n, k) vectors about their mean."""
    known = values[np.isfinite(values).all(axis=1)]
    if len(known) == 0:
        return 0.0
    return float(np.sqrt(((known - known.mean(axis=0)) ** 2).sum(axis=1).mean()))

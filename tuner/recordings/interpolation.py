"""Signals resampled on a uniform clock, and kinematics to compare them with each other."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tuner.core.numerics import Array, finite_rows
from tuner.recordings.flight import SIGNALS, Series

#: A signal is unknown in gaps longer than this, or than three periods of a slower signal.
GAP_S = 0.25
#: A gap of more periods of a regular publisher lacks a sample.
MIN_GAP_PERIODS = 1.5
#: The rate and length of the stretch whose frames and clocks are checked.
RATE_HZ = 100.0
MAX_STRETCH_S = 60.0


def resample(signal: str, series: Series, clock: Array) -> Array:
    """Return the (N, k) values of a signal on a uniform clock (N,), NaN where none are known."""
    columns, interpolation = SIGNALS[signal].columns, SIGNALS[signal].interpolation
    result = np.full((len(clock), columns), np.nan)
    if len(series.time) == 0:
        return result
    if interpolation == "arc":
        return _slerp(series, clock)
    for column in range(columns):
        time, values = series.column(column)
        if not len(time):
            continue
        if interpolation == "linear":
            result[:, column] = np.interp(clock, time, values)
            result[np.logical_not(_covered(time, clock)), column] = np.nan
        else:
            gap = np.inf if signal == "lap" else max_gap(time)  # a counter holds for good
            # A nanosecond of tolerance: stamps that were moved onto ticks carry rounding errors.
            index = np.searchsorted(time, clock + 1e-9, side="right") - 1
            last = np.maximum(index, 0)
            known = (index >= 0) & (clock - time[last] <= gap)
            result[:, column] = np.where(known, values[last], np.nan)
    return result


@np.errstate(over="ignore")  # of slopes near the least number
def with_gaps_filled(series: Series) -> Series:
    """Return a signal of a steady publisher with its missing samples interpolated.

    Recorders drop messages that the flight controller received. Held through such a gap, a
    reference at 4 m/s would lag by 4 cm for 10 ms and kick the vehicle. The missing samples are
    put on a monotone cubic through their neighbours (Fritsch and Butland 1984), which keeps steps.
    Gaps longer than `max_gap` stay.
    """
    known = series.complete()
    time, values = known.time, known.values
    if len(time) < 2:
        return series
    steps = np.diff(time)
    period = float(np.median(steps))
    gaps = np.flatnonzero((steps > MIN_GAP_PERIODS * period) & (steps <= max_gap(time)))
    if len(gaps) == 0:
        return series
    counts = np.round(steps[gaps] / period).astype(int)
    missing = np.concatenate(
        [
            time[gap] + steps[gap] * np.arange(1, count) / count
            for gap, count in zip(gaps, counts, strict=True)
        ]
    )
    from scipy.interpolate import PchipInterpolator  # noqa: PLC0415 (slow to import, seldom needed)

    steady = np.sort(np.concatenate([time, missing]))
    between = PchipInterpolator(time, values)(steady)
    between[np.searchsorted(steady, time)] = values
    return Series(steady, between)


def max_gap(time: Array) -> float:
    """Return the s between samples beyond which a signal is unknown."""
    return max(GAP_S, 3 * float(np.median(np.diff(time)))) if len(time) > 1 else GAP_S


def runs(flags: ArrayLike) -> list[tuple[int, int]]:
    """Return the first index of each run of true flags, and the one after its last."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], np.asarray(flags, np.int8), [0]])))
    return [(int(first), int(behind)) for first, behind in edges.reshape(-1, 2)]


def _covered(time: Array, clock: Array) -> NDArray[np.bool_]:
    """Return which instants have samples on both sides, not too far apart."""
    after = np.clip(np.searchsorted(time, clock, side="left"), 0, len(time) - 1)
    before = np.clip(np.searchsorted(time, clock, side="right") - 1, 0, len(time) - 1)
    inside = (clock >= time[0]) & (clock <= time[-1])
    near = time[after] - time[before] <= max_gap(time)
    return np.asarray(inside & near, dtype=np.bool_)


def _slerp(series: Series, clock: Array) -> Array:
    """Interpolate quaternions at constant angular speed along the shorter arc."""
    result = np.full((len(clock), 4), np.nan)
    known = _covered(series.time, clock)
    if len(series.time) < 2 or not known.any():
        return result
    at = clock[known]
    after = np.clip(np.searchsorted(series.time, at), 1, len(series.time) - 1)
    start, end = series.values[after - 1], series.values[after]
    part = (at - series.time[after - 1]) / (series.time[after] - series.time[after - 1])
    cosine = (start * end).sum(axis=1)
    end = np.where(cosine[:, None] < 0, -end, end)
    angle = np.arccos(np.clip(np.abs(cosine), 0.0, 1.0))
    # A smaller arc is a line to machine precision.
    tiny = angle < 1e-6
    sine = np.where(tiny, 1.0, np.sin(angle))
    from_start = np.where(tiny, 1 - part, np.sin((1 - part) * angle) / sine)
    from_end = np.where(tiny, part, np.sin(part * angle) / sine)
    arc = from_start[:, None] * start + from_end[:, None] * end
    arc /= np.linalg.norm(arc, axis=1)[:, None]
    flips = np.where((arc[1:] * arc[:-1]).sum(axis=1) < 0, -1.0, 1.0)
    sign = np.concatenate([[1.0], np.cumprod(flips)])
    result[known] = arc * (sign if arc[0, 0] >= 0 else -sign)[:, None]
    return result


def middle_clock(series: Mapping[str, Series]) -> Array:
    """Return a uniform clock over the middle of a recording, one minute at most."""
    time = series["position"].time
    start, end = float(time[0]), float(time[-1])
    spare = max(0.0, end - start - MAX_STRETCH_S) / 2
    return np.arange(start + spare, end - spare, 1 / RATE_HZ)


def smooth(values: Array, seconds: float = 0.05) -> Array:
    """Return the moving average of (n, k) values; NaN where the window is incomplete."""
    width = max(1, round(seconds * RATE_HZ) | 1)
    result = np.full(values.shape, np.nan)
    if len(values) >= width:
        kernel = np.ones(width) / width
        for column, averaged in zip(values.T, result.T, strict=True):
            averaged[width // 2 : len(values) - width // 2] = np.convolve(column, kernel, "valid")
    return result


def derivative(values: Array) -> Array:
    """Return the derivative in time of (n, k) values on the clock."""
    return np.asarray(np.gradient(values, 1 / RATE_HZ, axis=0))


def rotate(q: Array, v: Array) -> Array:
    """Return (n, 3) body vectors in world axes; `q` is (n, 4), w first."""
    w, xyz = q[:, :1], q[:, 1:]
    twice = 2 * np.cross(xyz, v)
    return np.asarray(v + w * twice + np.cross(xyz, twice))


def upward(q: Array) -> Array:
    """Return the body's z axis (n, 3) in world axes."""
    return rotate(q, np.tile([0.0, 0.0, 1.0], (len(q), 1)))


def body_rate_of(q: Array) -> Array:
    """Return the (n, 3) body rate, rad/s, of (n, 4) attitudes on the clock."""
    return body_rate_from(q, derivative(q))


def body_rate_from(q: Array, q_dot: Array) -> Array:
    """Return (n, 3) body rates, rad/s, of (n, 4) attitudes and their derivatives: 2 q* ⊗ dq/dt."""
    w, x, y, z = q.T
    dw, dx, dy, dz = q_dot.T
    return 2.0 * np.column_stack(
        [
            w * dx - x * dw - y * dz + z * dy,
            w * dy + x * dz - y * dw - z * dx,
            w * dz - x * dy + y * dx - z * dw,
        ]
    )


def both_known(a: Array, b: Array) -> tuple[Array, Array]:
    """Return the rows of two (n, k) signals at which all columns of both are known."""
    known = finite_rows(a) & finite_rows(b)
    return a[known], b[known]


def correlation(a: Array, b: Array) -> float:
    """Return the correlation of two (n, k) signals over all their columns, -1..1."""
    a, b = both_known(a, b)
    if len(a) < 20:
        return 0.0
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    size = float(np.sqrt((a * a).sum() * (b * b).sum()))
    return float((a * b).sum() / size) if size > 0 else 0.0


MAX_ALIGNING_TURN = 0.1
"""rad. A rigid body whose axes were set by eye is off by less."""


def correlation_aligned(a: Array, b: Array) -> float:
    """Return the `correlation` of two (n, 3) signals, with one turned a little so that it is best.

    The turn is that of least squares, to the first order, of at most `MAX_ALIGNING_TURN`.
    """
    a, b = both_known(a, b)
    if len(a) < 20:
        return 0.0
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    together, spread = a.T @ b, b.T @ b
    size = float(np.sqrt((a * a).sum() * np.trace(spread)))
    if size == 0.0:
        return 0.0
    levers = np.trace(spread) * np.eye(3) - spread
    skew = together - together.T
    turn = np.linalg.pinv(levers, rcond=1e-3) @ [skew[2, 1], skew[0, 2], skew[1, 0]]
    turn *= min(1.0, MAX_ALIGNING_TURN / max(float(np.linalg.norm(turn)), 1e-12))
    crossed = np.cross(np.eye(3), turn)
    turned = np.eye(3) + crossed + 0.5 * crossed @ crossed
    return float((turned * together).sum() / size)


def correlations(a: Array, b: Array, furthest: int) -> Array:
    """Return `correlation` with `a` moved back by each lag, but for rounding.

    Parameters
    ----------
    a, b
        Signals (n, k).
    furthest
        The lags, in rows, are -furthest, ..., furthest.
    """
    spectra = list[Any]()
    for values in (a, b):
        known = finite_rows(values)
        about = np.where(
            known[:, None], values - values[known].sum(axis=0) / max(known.sum(), 1), 0
        )
        held = np.column_stack([known, (about**2).sum(axis=1), about])
        spectra.append(np.fft.rfft(held, 2 ** (len(a) + furthest).bit_length(), axis=0))
    left, right = spectra[0], spectra[1].conj()

    def summed(product: Any) -> Array:
        """Return sums over the rows that both have at a lag, (lags, ...)."""
        return np.asarray(np.fft.irfft(product, axis=0)[np.arange(-furthest, furthest + 1)])

    count = np.maximum(np.rint(summed(left[:, 0] * right[:, 0])), 1)
    of_a, of_b = summed(left[:, 2:] * right[:, :1]), summed(left[:, :1] * right[:, 2:])
    squares = (
        np.column_stack([summed(left[:, 1] * right[:, 0]), summed(left[:, 0] * right[:, 1])])
        - np.column_stack([(of_a**2).sum(axis=1), (of_b**2).sum(axis=1)]) / count[:, None]
    )
    both = summed((left[:, 2:] * right[:, 2:]).sum(axis=1)) - (of_a * of_b).sum(axis=1) / count
    certain = (count >= 20) & (squares > 1e-9 * squares.max(axis=0)).all(axis=1)
    return np.where(certain, both / np.sqrt(np.where(certain, squares.prod(axis=1), 1.0)), 0.0)


def rms(values: Array) -> float:
    """Return the root mean square length of (n, k) vectors about their mean."""
    known = values[finite_rows(values)]
    if len(known) == 0:
        return 0.0
    return float(np.sqrt(((known - known.mean(axis=0)) ** 2).sum(axis=1).mean()))

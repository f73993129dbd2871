"""Steady parts of a stepwise experiment: where a signal keeps a level, transients left out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.ndimage import median_filter

from tuner.core.numerics import Z95, robust_sd
from tuner.ground.measurement import Array

OUTLIER = 3.0
"""Standard deviations (robust) beyond which a tachometer's sample is dropped (thesis 6.3.2)."""
MIDDLE = (0.3, 0.95)
"""Share of a step, from and to, that is its middle: transients over, the next not begun."""
TRUSTED = 4
"""Degrees of freedom from which the residuals' own scatter is the only measure of error."""
FEWEST = 8
"""Samples without which a step has no mean."""


@dataclass(frozen=True)
class Plateau:
    """One steady part.

    Attributes
    ----------
    samples
        Indices of the samples that count.
    begin, end
        s.
    """

    samples: NDArray[np.intp]
    begin: float
    end: float


def levels_of(signal: Array, time: Array, *, shortest: float, step: float) -> list[Plateau]:
    """Return the steady parts of a signal that moves in steps.

    Parameters
    ----------
    signal
        (n,) what was stepped: a command, or a rotor's speed, NaN where it was not measured.
    time
        (n,) s.
    shortest
        s below which a level is a transient.
    step
        Change of the level that counts as a step, in the signal's unit.
    """
    width = max(3, 2 * int(0.5 * shortest / max(float(np.median(np.diff(time))), 1e-9) / 2) + 1)
    filled = np.interp(np.arange(len(signal)), *_known(signal))
    smooth = median_filter(filled, size=width, mode="nearest")
    plateaus, first = [], 0
    level = smooth[0]
    for index in range(1, len(smooth) + 1):
        ended = index == len(smooth) or abs(smooth[index] - level) > step
        if not ended:
            count = index - first + 1
            level += (smooth[index] - level) / min(count, width)
            continue
        plateau = _middle(time, first, index)
        if plateau is not None and time[index - 1] - time[first] >= shortest:
            plateaus.append(plateau)
        if index < len(smooth):
            first, level = index, smooth[index]
    return plateaus


def _known(signal: Array) -> tuple[Array, Array]:
    known = np.flatnonzero(np.isfinite(signal))
    return known.astype(float), signal[known]


def _middle(time: Array, first: int, end: int) -> Plateau | None:
    begin, last = time[first], time[end - 1]
    low, high = (begin + share * (last - begin) for share in MIDDLE)
    samples = first + np.flatnonzero((time[first:end] >= low) & (time[first:end] <= high))
    return Plateau(samples, float(low), float(high)) if len(samples) >= FEWEST else None


def without_outliers(values: Array) -> NDArray[np.bool_]:
    """Return (n,) which values lie within `OUTLIER` robust standard deviations of their median."""
    finite = np.isfinite(values)
    middle = np.median(values[finite])
    spread = max(float(robust_sd(values[finite] - middle)), 1e-12 * abs(middle))
    return np.asarray(finite & (np.abs(values - middle) <= OUTLIER * spread))


def mean_and_error(values: Array) -> tuple[float, float]:
    """Return a plateau's mean and the standard error of it, correlation between samples included.

    The variance of the mean comes from the means of blocks, which neighbouring samples that move
    together make larger than the variance over the count.
    """
    count = len(values)
    blocks = min(8, count // 4)
    plain = float(values.std(ddof=1)) / np.sqrt(count)
    if blocks < 4:
        return float(values.mean()), plain
    means = np.array([block.mean() for block in np.array_split(values, blocks)])
    return float(values.mean()), max(plain, float(means.std(ddof=1)) / np.sqrt(blocks))


def widened(covariance: Array, chi_square: float, freedom: int) -> Array:
    """Return a covariance with the scatter of the residuals: Birge's ratio and Student's t.

    A few residuals that happen to be small do not narrow it.

    Parameters
    ----------
    covariance
        Of weighted least squares.
    chi_square, freedom
        Sum of the squared weighted residuals, and the degrees of freedom that they have.
    """
    ratio = chi_square / max(freedom, 1)
    ratio = max(ratio, 1.0) if freedom < TRUSTED else ratio
    return np.asarray(covariance * ratio * student(freedom) ** 2)


def student(freedom: int) -> float:
    """Return by what factor few degrees of freedom widen an interval (Student's t)."""
    return float(stats.t.ppf(0.975, max(freedom, 1))) / Z95

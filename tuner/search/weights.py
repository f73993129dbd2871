"""How much each channel of each flight weighs: by what the model leaves unexplained of it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tuner.objective.criterion import SegmentSums
from tuner.objective.normal import Objective

NEAR = 3.0
"""Multiple of the noise up to which a flight counts as met, by its worst channel."""
STRAY = 3.0
"""A flight that is met this many times worse than the median one counts less."""


def root_mean_squares(objective: Objective, sums: SegmentSums) -> dict[str, NDArray[np.float64]]:
    """Return channel -> (S, N) root mean square residual in σ of each flight, NaN without any.

    ``objective`` says which segment belongs to which flight; the segments' sums have S first.
    """
    owner, residual = np.eye(objective.flights)[np.asarray(objective.segments.flight)], {}
    for name, squares in sums.squares.items():
        counts = np.asarray(sums.counts[name]) @ owner
        mean = np.asarray(squares) @ owner / np.maximum(counts, 1.0)
        residual[name] = np.where(counts > 0, np.sqrt(mean), np.nan)
    return residual


def strays(
    residual: dict[str, NDArray[np.float64]], noise_inflation: float
) -> dict[str, NDArray[np.float64]]:
    """Weigh a flight down that is met far worse than the others, so that it cannot poison them."""
    table = np.stack(list(residual.values())) / noise_inflation
    with np.errstate(all="ignore"):
        per_flight = np.nan_to_num(np.nanmedian(table, axis=0), nan=1.0)
    typical = max(float(np.median(per_flight)), 1.0)
    stray = per_flight > STRAY * typical
    return {
        name: np.where(stray & np.isfinite(values), np.maximum(values / noise_inflation, 1.0), 1.0)
        for name, values in residual.items()
    }


def misfit(residual: dict[str, NDArray[np.float64]]) -> dict[str, NDArray[np.float64]]:
    """Return how much larger than noise each channel's residuals are on each flight, at least 1."""
    return {
        name: np.maximum(np.nan_to_num(values, nan=1.0), 1.0) for name, values in residual.items()
    }

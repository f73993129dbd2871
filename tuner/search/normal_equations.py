"""What the segments' sums say of a whole fit: its loss as a quadratic, and how flights are met.

Each of F segments contributes a loss, a gradient and a Gauss-Newton Hessian from which its own
start has been eliminated (`tuner.objective.normal`); they are summed over the segments and the
priors added. The residuals themselves, some hundred thousand, are never laid in one array. How much
each channel of each flight weighs follows from what the model leaves unexplained of it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tuner.objective.criterion import OFFSET_SD, Criterion, Point, SegmentSums
from tuner.objective.normal import Objective
from tuner.objective.space import Space

Array = NDArray[np.float64]


class NormalEquations(NamedTuple):
    """Loss c, gradient (P,) and Hessian (P, P) of a fit at a point, per compared value.

    The parameters are the coefficients, then the flights' offsets, one kind after the other.
    """

    loss: float
    gradient: Array
    hessian: Array


def normal_equations(
    space: Space,
    flight: ArrayLike,
    point: Point,
    criterion: Criterion,
    sums: SegmentSums,
) -> NormalEquations:
    """Return loss, gradient and Hessian over all segments, priors included.

    Everything is divided by the number of compared values, so that damping means the same at every
    horizon.

    Parameters
    ----------
    space
        Free coefficients and their priors.
    flight
        (F,) number of the flight that each segment belongs to.
    point, criterion, sums
        Where, in which terms, and what the segments contribute there.
    """
    vector, offsets = np.asarray(point.coefficients), np.asarray(point.offsets)
    count, (kinds, flights), prior = len(space), offsets.shape, criterion.prior
    compared = max(float(sums.compared), 1.0)
    rows = prior * space.prior_rows * space.slope(vector)
    pull, offset_pull = prior * space.prior_residuals(vector), offsets / OFFSET_SD
    loss = float(np.sum(sums.loss)) + 0.5 * float(np.sum(pull**2) + np.sum(offset_pull**2))
    owner = np.eye(flights)[np.asarray(flight)]  # (F, N)
    by_segment = np.asarray(sums.gradient)
    gradient = np.concatenate(
        [
            by_segment[:count].sum(axis=-1) + rows.T @ pull,
            (by_segment[count:] @ owner + offset_pull / OFFSET_SD).ravel(),
        ]
    )
    hessian = np.zeros((count + kinds * flights,) * 2)
    curved = np.asarray(sums.hessian)
    hessian[:count, :count] = curved[:count, :count].sum(axis=-1) + rows.T @ rows
    across = (curved[:count, count:] @ owner).reshape(count, -1)
    hessian[:count, count:], hessian[count:, :count] = across, across.T
    # a flight's offsets meet only each other
    own = hessian[count:, count:].reshape(kinds, flights, kinds, flights)
    each = np.arange(flights)
    own[:, each, :, each] = np.moveaxis(curved[count:, count:] @ owner, -1, 0)
    own_diagonal = np.arange(count, len(hessian))
    hessian[own_diagonal, own_diagonal] += 1.0 / OFFSET_SD**2
    return NormalEquations(loss / compared, gradient / compared, hessian / compared)


NEAR = 3.0
"""Multiple of the noise up to which a flight counts as met, by its worst channel."""
STRAY = 3.0
"""A flight that is met this many times worse than the median one counts less."""


def root_mean_squares(objective: Objective, sums: SegmentSums) -> dict[str, NDArray[np.float64]]:
    """Return channel -> (S, N) root mean square residual in σ of each flight, NaN without any.

    ``objective`` says which segment belongs to which flight; the segments' sums have S first.
    """
    owner, residual = np.eye(objective.flights)[objective.flight], {}
    for name, squares in sums.squares.items():
        counts = np.asarray(sums.counts[name]) @ owner
        mean = np.asarray(squares) @ owner / np.maximum(counts, 1.0)
        residual[name] = np.where(counts > 0, np.sqrt(mean), np.nan)
    return residual


def position_rmse(
    objective: Objective, squares: Mapping[str, Array], counts: Mapping[str, Array]
) -> float:
    """Return the position RMSE in m, of channel -> squares in σ and counts; NaN without any."""
    if "position" not in counts:
        return float("nan")
    sigma = 1.0 / np.asarray(objective.segments.measured["position"].weight).max(initial=1e-30)
    compared = float(np.sum(counts["position"])) or np.nan
    return float(sigma * np.sqrt(3.0 * float(np.sum(squares["position"])) / compared))


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

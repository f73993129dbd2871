"""What the segments' sums say of a whole fit: its loss as a quadratic, and how flights are met.

Each of F segments contributes a loss, a gradient and a Gauss-Newton Hessian from which its own
start has been eliminated (`tuner.objective.normal`); they are summed over the segments and the
priors added. The residuals themselves, some hundred thousand, are never laid in one array. How much
each channel of each flight weighs follows from what the model leaves unexplained of it.
"""

from __future__ import annotations

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
    count, (kinds, flights), prior = len(space), offsets.shape, float(criterion.prior)
    compared = max(sum(float(np.sum(n)) for n in sums.counts.values()), 1.0)
    slope = space.slope(vector)
    pull = (space.scaled(vector) - space.prior_mean) / space.prior_sd * prior
    pulled = slope / space.prior_sd * prior
    offset_pull = offsets / OFFSET_SD
    loss = float(np.sum(sums.loss)) + 0.5 * float(np.sum(pull**2) + np.sum(offset_pull**2))
    owner = np.eye(flights)[np.asarray(flight)]  # (F, N)
    by_segment = np.asarray(sums.gradient)
    gradient = np.concatenate(
        [
            by_segment[:count].sum(axis=-1) + pulled * pull,
            (by_segment[count:] @ owner + offset_pull / OFFSET_SD).ravel(),
        ]
    )
    hessian = np.zeros((count + kinds * flights,) * 2)
    curved = np.asarray(sums.hessian)
    hessian[:count, :count] = curved[:count, :count].sum(axis=-1) + np.diag(pulled**2)
    joint_pull = (space.joint_rows @ space.scaled(vector) + space.joint_offset) * prior
    joint_slope = space.joint_rows * slope * prior
    loss += 0.5 * float(np.sum(joint_pull**2))
    gradient[:count] += joint_slope.T @ joint_pull
    hessian[:count, :count] += joint_slope.T @ joint_slope
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

"""The normal equations of a whole fit, and the least-squares problem that has the same.

Each of F segments contributes a loss, a gradient and a Gauss-Newton Hessian from which its own
start has been eliminated (`tuner.objective.simulator`); `normal_equations` sums them over the
segments and adds the priors: loss c, gradient g (P,) and Hessian H (P, P). The residuals
themselves, some hundred thousand, are never laid in one array.

optimistix's least-squares solvers ask for residuals. `linear_residuals` gives the smallest problem
that has these normal equations. With H = L Lᵀ (Cholesky) and y₀ the point where they were computed,

    r(y) = [ L⁻¹ g + Lᵀ (y - y₀) ]        P rows
           [ √(2c - |L⁻¹ g|²)    ]        one row, constant

so that at y₀ ½|r|² = c, Jᵀr = L L⁻¹ g = g and JᵀJ = L Lᵀ = H. A Gauss-Newton method, the
Levenberg-Marquardt method among them, depends on the residuals through these three alone: it takes
the step that it would take on all of them.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import Float

from tuner.objective.criterion import OFFSET_SD, Criterion, Point, SegmentSums
from tuner.objective.space import Coordinates, Space

RIDGE = 1e-13
"""Added to the Hessian's diagonal, relative to its largest element: a singular one has a factor."""


def normal_equations(
    space: Space | Coordinates,
    flight: ArrayLike,
    point: Point,
    criterion: Criterion,
    sums: SegmentSums,
) -> tuple[Array, Array, Array]:
    """Return loss, gradient (P,) and Hessian (P, P) over all segments, priors included.

    The parameters are the coefficients, then the flights' offsets, one kind after the other;
    everything is divided by the number of compared values, so that damping means the same at every
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
    count, (kinds, flights) = len(space), point.offsets.shape
    compared = jnp.maximum(sum(jnp.sum(n) for n in sums.counts.values()), 1.0)
    mean, sd = jnp.asarray(space.prior_mean), jnp.asarray(space.prior_sd)

    def prior(vector: Array) -> Array:
        return (space.scaled(vector) - mean) / sd * criterion.prior

    pull, slope = jax.jvp(prior, (point.coefficients,), (jnp.ones(count),))
    offset_pull = point.offsets / OFFSET_SD
    loss = jnp.sum(sums.loss) + 0.5 * (jnp.sum(pull**2) + jnp.sum(offset_pull**2))
    owner = (jnp.arange(flights)[:, None] == jnp.asarray(flight)).astype(sums.gradient.dtype)
    offset_gradient = sums.gradient[count:] @ owner.T + offset_pull / OFFSET_SD
    gradient = jnp.concatenate(
        [jnp.sum(sums.gradient[:count], axis=-1) + slope * pull, offset_gradient.ravel()]
    )
    shared = jnp.sum(sums.hessian[:count, :count], axis=-1) + jnp.diag(slope**2)
    if space.joint_rows is not None:
        rows, offset = jnp.asarray(space.joint_rows), jnp.asarray(space.joint_offset)
        along = jnp.ones(count)
        scaled, turn = jax.jvp(space.scaled, (point.coefficients,), (along,))
        joint_pull = (rows @ scaled + offset) * criterion.prior
        joint_slope = rows * turn * criterion.prior
        loss = loss + 0.5 * jnp.sum(joint_pull**2)
        gradient = gradient.at[:count].add(joint_slope.T @ joint_pull)
        shared = shared + joint_slope.T @ joint_slope
    across = (sums.hessian[:count, count:] @ owner.T).reshape(count, -1)
    per_flight = sums.hessian[count:, count:] @ owner.T  # (kinds, kinds, N)
    spread = per_flight[:, :, :, None] * jnp.eye(flights)  # a flight's offsets meet only each other
    block = jnp.moveaxis(spread, 2, 1).reshape(kinds * flights, kinds * flights)
    block = block + jnp.eye(len(block)) / OFFSET_SD**2
    hessian = jnp.block([[shared, across], [across.T, block]])
    return loss / compared, gradient / compared, hessian / compared


class LinearResiduals(eqx.Module):
    """The residuals r(y) of the head of this file, as the numbers that they are made of.

    Attributes
    ----------
    factor
        L, lower triangular.
    residual
        r(y₀): L⁻¹ g, then the constant row.
    origin
        y₀.
    """

    factor: Float[Array, "P P"]
    residual: Float[Array, " P+1"]
    origin: Float[Array, " P"]


def linear_residuals(
    origin: Array, loss: Array, gradient: Array, hessian: Array, free: ArrayLike
) -> LinearResiduals:
    """Return the residuals with some normal equations at a point.

    Parameters
    ----------
    origin
        (P,) the point.
    loss, gradient, hessian
        As `normal_equations` returns them.
    free
        (P,) one for what may move; a parameter with zero has no gradient and moves nothing.
    """
    free = jnp.asarray(free)
    gradient = gradient * free
    hessian = hessian * free[:, None] * free[None] + jnp.diag(1.0 - free)
    ridge = RIDGE * jnp.max(jnp.diag(hessian))
    factor = jnp.linalg.cholesky(hessian + ridge * jnp.eye(len(free)))
    residual = jax.scipy.linalg.solve_triangular(factor, gradient, lower=True)
    rest = jnp.sqrt(jnp.maximum(2.0 * loss - residual @ residual, 0.0))
    return LinearResiduals(factor, jnp.concatenate([residual, rest[None]]), origin)


def residuals_at(parameters: Array, linear: LinearResiduals) -> tuple[Array, Any]:
    """Return r(y) and no auxiliary output: the function that optimistix is given."""
    moved = linear.factor.T @ (parameters - linear.origin)
    return linear.residual + jnp.concatenate([moved, jnp.zeros(1, moved.dtype)]), None

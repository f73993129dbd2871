"""The loss of residuals: half their squares, growing linearly beyond a limit (Huber)."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from tuner.objective.segments import Segments


def robust(error: Array, limit: Array) -> Array:
    """Return Huber's loss of an error: its square, growing linearly beyond a limit."""
    size = jnp.abs(error)
    return jnp.where(size > limit, 2.0 * limit * size - limit * limit, error * error)


def robust_loss(scaled: dict[str, Array], huber: Array) -> Array:
    """Return half the robust sum of squares (F,) of channel -> (n, k, F) scaled residuals."""
    sums = (jnp.sum(robust(error, huber), axis=(0, 1)) for error in scaled.values())
    return 0.5 * sum(sums, jnp.zeros(()))


def gauss_newton(
    columns: dict[str, Array], scaled: dict[str, Array], scale: dict[str, Array], huber: Array
) -> tuple[Array, Array]:
    """Return gradient (Q, F) and Gauss-Newton Hessian (Q, Q, F) of the robust loss.

    Parameters
    ----------
    columns
        Channel -> (Q, n, k, F) derivatives of the unscaled residuals.
    scaled, scale
        Channel -> (n, k, F) residuals, and the (F,) by which they were divided.
    huber
        As for `robust`.
    """
    gradient: Array = jnp.zeros(())
    hessian: Array = jnp.zeros(())
    for name, error in scaled.items():
        size = jnp.abs(error)
        weight = jnp.where(size > huber, huber / jnp.where(size > 0, size, 1.0), 1.0)
        column = columns[name] / scale[name]
        weighted = column * weight
        gradient = gradient + jnp.einsum("pnkf,nkf->pf", weighted, error)
        hessian = hessian + jnp.einsum("pnkf,qnkf->pqf", weighted, column)
    return gradient, hessian


def count(segments: Segments, name: str, rate: float, horizon: Array) -> Array:
    """Return how many values (F,) of a channel are compared up to a horizon in samples."""
    measured = segments.measured[name]
    flown = measured.time * rate < horizon - 1
    return jnp.sum((measured.weight > 0) & flown[:, None], axis=(0, 1)).astype(float)

"""Scalars with derivatives that stay finite where the plain functions' do not."""

from __future__ import annotations

from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

Array: TypeAlias = jax.Array | np.ndarray
"""Of jax, or of NumPy: what is laid out on the host compiles nothing."""

#: One number per vehicle of the batch; shape () for a single vehicle or one that all share.
Scalar: TypeAlias = Float[Array, "*#batch"]
#: One truth value per vehicle of the batch.
Flag: TypeAlias = Bool[Array, "*#batch"]


def saturate(value: Scalar, lower: Scalar | float, upper: Scalar | float) -> Scalar:
    """Limit a value; at a limit the derivative is the inner one, not the mean of both sides."""
    return jnp.where(value < lower, lower, jnp.where(value > upper, upper, value))


def smaller(first: Scalar, second: Scalar) -> Scalar:
    """Return the smaller of two; where they are equal the derivative is the second's."""
    return jnp.where(first < second, first, second)


def larger(first: Scalar, second: Scalar) -> Scalar:
    """Return the larger of two; where they are equal the derivative is the second's."""
    return jnp.where(first > second, first, second)


def magnitude(value: Scalar) -> Scalar:
    """Return the absolute value; at zero the derivative is that from above."""
    return jnp.where(value < 0, -value, value)


def safe_sqrt(square: Scalar) -> Scalar:
    """Return the square root, with derivative zero instead of infinite at zero."""
    positive = square > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1.0)), 0.0)


def safe_divide(numerator: Scalar, denominator: Scalar) -> Scalar:
    """Divide, giving zero with derivative zero where the denominator is zero."""
    nonzero = denominator != 0
    return jnp.where(nonzero, numerator / jnp.where(nonzero, denominator, 1.0), 0.0)


@jax.custom_batching.custom_vmap
def anyone(flags: Flag) -> Bool[Array, ""]:
    """Return whether any vehicle is flagged, those of an outer `jax.vmap` included.

    One truth value for all, so that a `lax.cond` on it remains a branch under `jax.vmap`.
    """
    return jnp.any(flags)


@anyone.def_vmap
def _(_: int, __: list[bool], flags: Flag) -> tuple[Bool[Array, ""], bool]:
    return anyone(flags), False

"""Scalars with derivatives that stay finite where the plain functions' do not; whole pytrees."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, ParamSpec, TypeAlias, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Bool, Float, Int, PyTree

Array: TypeAlias = jax.Array | np.ndarray
"""Of jax, or of NumPy: arrays on the host compile nothing."""

#: One number per vehicle of the batch; shape () for a single vehicle or one that all share.
Scalar: TypeAlias = Float[Array, "*#batch"]
#: One truth value per vehicle of the batch.
Flag: TypeAlias = Bool[Array, "*#batch"]


def saturate(value: Scalar, lower: Scalar | float, upper: Scalar | float) -> Scalar:
    """Limit a value; at a limit the derivative is the inner one, not the mean of both sides."""
    return jnp.where(value < lower, lower, jnp.where(value > upper, upper, value))


def minimum(first: Scalar, second: Scalar) -> Scalar:
    """Return the smaller of two; where they are equal the derivative is the second's."""
    return jnp.where(first < second, first, second)


def maximum(first: Scalar, second: Scalar) -> Scalar:
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
def any_lane(flags: Flag) -> Bool[Array, ""]:
    """Return whether any vehicle is flagged, those of an outer `jax.vmap` included.

    One truth value for all, so that a `lax.cond` on it remains a branch under `jax.vmap`.
    """
    return jnp.any(flags)


@any_lane.def_vmap
def _(_: int, __: list[bool], flags: Flag) -> tuple[Bool[Array, ""], bool]:
    return any_lane(flags), False


Precision: TypeAlias = Literal["float32", "float64"]
P = ParamSpec("P")
T = TypeVar("T")


def where(flag: Array, first: T, second: T) -> T:
    """Choose between two pytrees leaf by leaf; the flag broadcasts."""
    chosen: T = jax.tree.map(lambda a, b: jnp.where(flag, a, b), first, second)
    return chosen


def repeat(count: int, body: Callable[[Array, T], T], start: T) -> T:
    """Run ``carried = body(number, carried)`` so many times; once without a loop."""
    if count == 1:
        return body(jnp.asarray(0), start)
    end: T = lax.fori_loop(0, count, body, start)
    return end


def rematerialised(function: Callable[P, T]) -> Callable[P, T]:
    """Let reverse mode store a function's arguments only, and recompute the rest."""
    again: Callable[P, T] = jax.checkpoint(function, prevent_cse=False)
    return again


def row_of(tree: PyTree[Array], index: Int[Array, ""]) -> PyTree[Array]:
    """Return one row of every leaf, by a traced index along the first axis."""
    return jax.tree.map(lambda leaf: lax.dynamic_index_in_dim(leaf, index, 0, keepdims=False), tree)


def cast_like(tree: PyTree[Array], other: T) -> T:
    """Return a pytree in the shapes and precision of another."""
    same: T = jax.tree.map(lambda a, b: jnp.broadcast_to(a, b.shape).astype(b.dtype), tree, other)
    return same


def replaced(tree: T, **changes: object) -> T:
    """Return a pytree with some of its parts replaced; None may become a part."""
    names = list(changes)
    changed: T = eqx.tree_at(
        lambda t: [getattr(t, name) for name in names],
        tree,
        [changes[name] for name in names],
        is_leaf=lambda leaf: leaf is None,
    )
    return changed


def in_precision(tree: T, dtype: np.dtype[np.floating]) -> T:
    """Return a pytree with its real numbers in a precision; whole numbers and flags stay."""

    def cast(leaf: object) -> object:
        real = jnp.issubdtype(jnp.result_type(leaf), jnp.floating)
        return jnp.asarray(leaf, dtype) if real else leaf

    changed: T = jax.tree.map(cast, tree)
    return changed


def precision_of(*trees: object) -> np.dtype[np.floating]:
    """Return the precision that holds all real numbers of some pytrees."""
    types = [jnp.result_type(leaf) for leaf in jax.tree.leaves(trees)]
    real = [dtype for dtype in types if jnp.issubdtype(dtype, jnp.floating)]
    widest: np.dtype[np.floating] = jnp.result_type(*real)
    return widest

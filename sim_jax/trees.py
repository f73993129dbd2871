"""Small things done to a whole pytree at once: choices, rows, loops, precision."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, ParamSpec, TypeAlias, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Int, PyTree

from sim_jax.numeric import Array

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


def forgetful(function: Callable[P, T]) -> Callable[P, T]:
    """Let reverse mode remember a function's arguments only, and compute the rest again."""
    again: Callable[P, T] = jax.checkpoint(function, prevent_cse=False)
    return again


def row_of(tree: PyTree[Array], index: Int[Array, ""]) -> PyTree[Array]:
    """Return one row of every leaf, by a traced index along the first axis."""
    return jax.tree.map(lambda leaf: lax.dynamic_index_in_dim(leaf, index, 0, keepdims=False), tree)


def like(tree: PyTree[Array], other: T) -> T:
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

"""Single or double precision: what a rollout computes in."""

from __future__ import annotations

from typing import Literal, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

Precision: TypeAlias = Literal["float32", "float64"]
T = TypeVar("T")


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

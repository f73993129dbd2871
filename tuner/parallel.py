"""A batch over all devices: each takes its share of the last axis."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import PyTree

_AXIS = "batch"


def _last_axis(tree: PyTree[Array]) -> PyTree[PartitionSpec]:
    return jax.tree.map(lambda leaf: PartitionSpec(*[None] * (leaf.ndim - 1), _AXIS), tree)


def _size(tree: PyTree[Array]) -> int:
    sizes = {jnp.shape(leaf)[-1] if jnp.ndim(leaf) else 0 for leaf in jax.tree.leaves(tree)}
    if len(sizes) != 1 or 0 in sizes:
        raise ValueError(f"the last axes of a batch must be equal and not empty: {sorted(sizes)}")
    return sizes.pop()


def _padded(tree: PyTree[Array], missing: int) -> PyTree[Array]:
    def pad(leaf: Array) -> Array:
        return jnp.concatenate([leaf, jnp.repeat(leaf[..., -1:], missing, axis=-1)], axis=-1)

    return jax.tree.map(pad, tree)


def over_devices(
    function: Callable[..., PyTree[Array]], *, devices: int | None = None
) -> Callable[..., PyTree[Array]]:
    """Return the same function of a batch, computed by all devices at once.

    The devices do not wait for each other inside the function: each runs its own loops. With one
    device the function is called as it is. May be used under `jax.jit`, `jax.jvp` and `jax.vmap`,
    and ``function`` may itself be a Jacobian.

    Parameters
    ----------
    function
        Takes a batch, a pytree whose leaves all have the batch as their last axis, then any number
        of pytrees that every device needs whole; returns a pytree whose leaves have the batch last.
        Members of the batch must not depend on each other.
    devices
        How many devices to use; all of the default backend by default.
    """

    @wraps(function)
    def shared_out(batch: PyTree[Array], *whole: PyTree[Array]) -> PyTree[Array]:
        chosen = jax.devices()[:devices]
        size = _size(batch)
        chosen = chosen[:size]
        if len(chosen) == 1:
            return function(batch, *whole)
        missing = -size % len(chosen)
        padded = _padded(batch, missing) if missing else batch
        shapes = jax.eval_shape(function, padded, *whole)
        result = jax.shard_map(
            function,
            mesh=Mesh(np.array(chosen), (_AXIS,)),
            in_specs=(_last_axis(padded), *[PartitionSpec()] * len(whole)),
            out_specs=_last_axis(shapes),
            # loops start from constants, which are the same on every device, and end in values
            # that are not: the check of what varies over devices would refuse them
            check_vma=False,
        )(padded, *whole)
        return jax.tree.map(lambda leaf: leaf[..., :size], result) if missing else result

    return shared_out

"""A batch over all devices, each its share of the last axis, and there in pieces."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, wraps
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.extend.core import jaxpr_as_fun
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import PyTree
from numpy.typing import NDArray

from tuner.kept_programs import kept

_AXIS = "batch"
_ROW = 768
"""bytes that one variable of a piece may take: some fifty then lie in a first-level cache of 32 kB.
Measured for rollouts in both precisions and for Jacobians of a dozen columns: with twice as much
both are slower, with half as much rollouts are."""
_FEWEST = 8
"""Members that fill a vector register."""
FINE = 16
"""Steps of `padded_size` for what costs time in proportion."""


def _last_axis(tree: PyTree[Array]) -> PyTree[PartitionSpec]:
    return jax.tree.map(lambda leaf: PartitionSpec(*[None] * (leaf.ndim - 1), _AXIS), tree)


def _size(tree: PyTree[Array]) -> int:
    sizes = {jnp.shape(leaf)[-1] if jnp.ndim(leaf) else 0 for leaf in jax.tree.leaves(tree)}
    if len(sizes) != 1 or 0 in sizes:
        raise ValueError(f"the last axes of a batch must be equal and not empty: {sorted(sizes)}")
    return sizes.pop()


def _padded(tree: PyTree[Array], missing: int) -> PyTree[Array]:
    def pad(leaf: Array) -> NDArray[Any]:
        rows = np.asarray(leaf)
        return np.concatenate([rows, np.repeat(rows[..., -1:], missing, axis=-1)], axis=-1)

    return jax.tree.map(pad, tree)


def over_devices(
    function: Callable[..., PyTree[Array]], *, name: object = None
) -> Callable[..., PyTree[Array]]:
    """Return a function of a batch compiled for all devices, each of which takes its share.

    The devices never wait for each other: nothing is exchanged between them, padding and joining
    happen on the host. (Reductions over a shared axis inside the compiled program would have them
    meet, and with a single thread for all devices a meeting can wait for ever.) A batch is filled
    up to a size that others have, too, for every size is compiled anew.

    Parameters
    ----------
    function
        Takes a batch, a pytree whose leaves all have the batch as their last axis, then any number
        of pytrees that every device needs whole; returns a pytree whose leaves have the batch last.
        Members of the batch must not depend on each other. It may itself be a Jacobian.
    name
        All that the function depends on beside its arguments and its source, as texts, numbers and
        data classes: what is traced is then kept on disk, see `tuner.kept_programs`.

    Returns
    -------
    callable
        The same function, not to be used under jax's transformations; its leaves are numpy arrays.
    """
    compiled = lru_cache(maxsize=8)(lambda count: jax.jit(shared_among(function, count, name)))

    @wraps(function)
    def shared_out(batch: PyTree[Array], *whole: PyTree[Array]) -> PyTree[Array]:
        size = _size(batch)
        count = min(len(jax.devices()), size)
        missing = count * padded_size(-(-size // count), FINE) - size
        result = compiled(count)(_padded(batch, missing) if missing else batch, *whole)
        return jax.tree.map(lambda leaf: np.asarray(leaf)[..., :size], result)

    return shared_out


def shared_among(
    function: Callable[..., PyTree[Array]], count: int, name: object = None
) -> Callable[..., PyTree[Array]]:
    """Return a function of a batch, to be compiled, that so many devices share equally.

    What it returns stays with the devices. ``function`` and ``name`` are as for `over_devices`; the
    size of the batch must be a multiple of ``count``.
    """
    if count == 1 and name is None:
        return function

    def over_all(batch: PyTree[Array], *whole: PyTree[Array]) -> PyTree[Array]:
        share = jax.tree.map(
            lambda leaf: jax.ShapeDtypeStruct(
                (*leaf.shape[:-1], leaf.shape[-1] // count), leaf.dtype
            ),
            batch,
        )
        arguments = (share, *whole)
        traced, shapes = (None if name is None else kept(function, name, arguments)) or _traced(
            function, *arguments
        )
        if count == 1:
            return traced(batch, *whole)
        return jax.shard_map(
            traced,
            mesh=Mesh(np.array(jax.devices()[:count]), (_AXIS,)),
            in_specs=(_last_axis(batch), *[PartitionSpec()] * len(whole)),
            out_specs=_last_axis(shapes),
            # loops start from constants, which are the same on every device, and end in values
            # that are not: the check of what varies over devices would refuse them
            check_vma=False,
        )(batch, *whole)

    return over_all


def _traced(
    function: Callable[..., PyTree[Array]], *arguments: PyTree[Array]
) -> tuple[Callable[..., PyTree[Array]], PyTree[jax.ShapeDtypeStruct]]:
    """Return a function traced for some arguments, and the shapes of what it returns.

    To ask for the shapes alone would trace twice, which for derivatives of a flight takes seconds.
    """
    closed, shapes = jax.make_jaxpr(function, return_shape=True)(*arguments)
    structure = jax.tree.structure(shapes)
    flat = jaxpr_as_fun(closed)

    def again(*arguments: PyTree[Array]) -> PyTree[Array]:
        return jax.tree.unflatten(structure, flat(*jax.tree.leaves(arguments)))

    return again, shapes


def in_pieces(function: Callable[..., PyTree[Array]], piece: int) -> Callable[..., PyTree[Array]]:
    """Return the same function of a batch, computed for at most so many members at a time.

    What it needs beside arguments and result does not grow with the batch then. Where the batch is
    no multiple of the pieces, the last two overlap. May be used under jax's transformations.

    Parameters
    ----------
    function
        As for `over_devices`.
    piece
        Members at a time; see `piece_that_fits`.
    """

    @wraps(function)
    def piecewise(batch: PyTree[Array], *whole: PyTree[Array]) -> PyTree[Array]:
        size = _size(batch)
        if size <= piece:
            return function(batch, *whole)

        def begin(number: int | Array) -> Array:
            return jnp.minimum(number * piece, size - piece)

        def part_from(first: Array) -> PyTree[Array]:
            taken = jax.tree.map(
                lambda leaf: lax.dynamic_slice_in_dim(leaf, first, piece, axis=-1), batch
            )
            return function(taken, *whole)

        part, shapes = _traced(part_from, begin(0))

        def joined_with(number: Array, joined: PyTree[Array]) -> PyTree[Array]:
            first = begin(number)
            return jax.tree.map(
                lambda into, leaf: lax.dynamic_update_slice_in_dim(into, leaf, first, axis=-1),
                joined,
                part(first),
            )

        empty = jax.tree.map(lambda leaf: jnp.zeros((*leaf.shape[:-1], size), leaf.dtype), shapes)
        return lax.fori_loop(0, -(-size // piece), joined_with, empty)

    return piecewise


def piece_that_fits(itemsize: int, columns: int = 1) -> int:
    """Return how many members to compute at a time so that a step's variables stay in the cache.

    Parameters
    ----------
    itemsize
        Bytes of a number: 4 or 8.
    columns
        Numbers that each variable holds for one member: those of a Jacobian's columns.
    """
    segments = max(_FEWEST, _ROW // (itemsize * columns))
    return 1 << (segments.bit_length() - 1)


def padded_size(count: int, steps: int = 4) -> int:
    """Return a size that is no smaller, of which there are ``steps`` between two powers of two.

    Compiled code belongs to the shapes it was compiled for. Sizes up to twice ``steps`` stay as
    they are; others grow by less than one part in ``steps``.
    """
    grain = max(1, (1 << (count - 1).bit_length()) // (2 * steps)) if count > 0 else 1
    return -(-count // grain) * grain

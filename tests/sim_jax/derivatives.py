"""Derivatives against finite differences: from both sides, and at kinks from one."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

SMALL = 1e-6


def raveled(tree: Any) -> np.ndarray:
    """Return the leaves of a pytree one after the other."""
    return np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(tree)])


class Differences:
    """A function whose derivatives can be held against finite differences, compiled once.

    Forward and reverse mode must agree to rounding. Along each axis the derivative equals the
    central finite difference or, at a kink, that of one of its two sides, component by component.
    """

    def __init__(self, function: Callable[..., Any], *example: Any) -> None:
        leaves, structure = jax.tree.flatten(example)
        ends = np.cumsum([jnp.size(leaf) for leaf in leaves])[:-1]

        def flat(values: jax.Array) -> jax.Array:
            parts = zip(jnp.split(values, ends), leaves, strict=True)
            point = [part.reshape(jnp.shape(leaf)) for part, leaf in parts]
            found = function(*jax.tree.unflatten(structure, point))
            return jnp.concatenate([jnp.ravel(leaf) for leaf in jax.tree.leaves(found)])

        def of(values: jax.Array) -> tuple[jax.Array, ...]:
            value, pull = jax.vjp(flat, values)
            (reverse,) = jax.vmap(pull)(jnp.eye(len(value)))
            return value, jax.jacfwd(flat)(values), reverse

        self._of = jax.jit(of)

    def of(self, start: np.ndarray) -> list[np.ndarray]:
        """Return the values at a point, and their derivatives in forward and in reverse mode."""
        return [np.asarray(part) for part in self._of(start)]

    def jacobian(self, *point: Any) -> np.ndarray:
        """Return the derivatives at a point, finite and the same in both modes."""
        _, forward, reverse = self.of(raveled(point))
        assert np.all(np.isfinite(forward))
        np.testing.assert_allclose(reverse, forward, rtol=1e-9, atol=1e-12)
        return forward

    def hold(
        self,
        *point: Any,
        kink: bool = False,
        tolerance: float = 1e-6,
        along: slice = slice(None),
    ) -> None:
        """Hold derivatives, all or those ``along`` some numbers of a point, against differences.

        They agree to a share of their size.
        """
        start, slope = raveled(point), self.jacobian(*point)
        steps = SMALL * np.maximum(np.abs(start), 1.0)
        moves, steps, slope = np.diag(steps)[along], steps[along], slope[:, along]
        here = self.of(start)[0]
        above = np.stack([self.of(start + move)[0] - here for move in moves], axis=-1)
        below = np.stack([here - self.of(start - move)[0] for move in moves], axis=-1)
        above, below = above / steps, below / steps
        size = tolerance * np.maximum(1.0, np.abs(slope))
        if kink:
            assert np.any(np.abs(above - below) > 1e-3), "there is no kink at this point"
            apart = np.minimum(np.abs(slope - above), np.abs(slope - below))
            size = 10 * size  # one-sided differences are of first order
        else:
            apart = np.abs(slope - 0.5 * (above + below))
        assert np.all(apart <= size), f"{np.max(apart / size)} times the tolerance"


@lru_cache(maxsize=16)
def _differences(
    function: Callable[..., Any], structure: Any, shapes: tuple[tuple[int, ...], ...]
) -> Differences:
    return Differences(function, *jax.tree.unflatten(structure, [jnp.zeros(s) for s in shapes]))


def assert_derivatives(function: Callable[..., Any], *point: Any, **how: Any) -> None:
    """Hold a function's derivatives at one point against finite differences."""
    leaves, structure = jax.tree.flatten(point)
    shapes = tuple(jnp.shape(leaf) for leaf in leaves)
    _differences(function, structure, shapes).hold(*point, **how)

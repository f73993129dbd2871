"""Derivatives against finite differences: from both sides, and at kinks from one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

SMALL = 1e-6


class Differences:
    """A function whose derivatives can be held against finite differences, compiled once.

    Forward and reverse mode must agree to rounding. Along each axis the derivative equals the
    central finite difference or, at a kink, that of one of its two sides, component by component.
    """

    def __init__(self, function: Callable[..., Any], *example: Any) -> None:
        _, unravel = ravel_pytree(example)

        def flat(values: jax.Array) -> jax.Array:
            return ravel_pytree(function(*unravel(values)))[0]

        self.value = jax.jit(flat)
        self.forward = jax.jit(jax.jacfwd(flat))
        self.reverse = jax.jit(jax.jacrev(flat))

    def jacobian(self, *point: Any) -> np.ndarray:
        """Return the derivatives at a point, finite and the same in both modes."""
        start, _ = ravel_pytree(point)
        forward, reverse = np.asarray(self.forward(start)), np.asarray(self.reverse(start))
        assert np.all(np.isfinite(forward))
        np.testing.assert_allclose(reverse, forward, rtol=1e-9, atol=1e-12)
        return forward

    def hold(self, *point: Any, kink: bool = False, tolerance: float = 1e-6) -> None:
        """Hold the derivatives at a point against differences, to a share of their size."""
        start, _ = ravel_pytree(point)
        slope = self.jacobian(*point)
        steps = SMALL * np.maximum(np.abs(start), 1.0)
        axes = [(step, jnp.zeros(len(steps)).at[row].set(step)) for row, step in enumerate(steps)]
        here = self.value(start)
        above = np.stack([(self.value(start + move) - here) / h for h, move in axes], axis=-1)
        below = np.stack([(here - self.value(start - move)) / h for h, move in axes], axis=-1)
        size = tolerance * np.maximum(1.0, np.abs(slope))
        if kink:
            assert np.any(np.abs(above - below) > 1e-3), "there is no kink at this point"
            apart = np.minimum(np.abs(slope - above), np.abs(slope - below))
            size = 10 * size  # one-sided differences are of first order
        else:
            apart = np.abs(slope - 0.5 * (above + below))
        assert np.all(apart <= size), f"{np.max(apart / size)} times the tolerance"


def assert_derivatives(function: Callable[..., Any], *point: Any, **how: Any) -> None:
    """Hold a function's derivatives at one point against finite differences."""
    Differences(function, *point).hold(*point, **how)

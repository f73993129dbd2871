"""Forward, Jacobian and gradient of 64 flights: ``... contestants.derivatives jacobian``."""

from __future__ import annotations

import sys

from benchmarks.timing import answer
from tuner.core import runtime

runtime.configure()

import jax  # noqa: E402 (after the set-up)
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from jax import Array  # noqa: E402

from benchmarks.case import Kernel, factors, fly  # noqa: E402

FLIGHTS, SAMPLES, REVERSED = 64, 2000, 8
FORWARD, JACOBIAN, GRADIENT = "forward", "jacobian", "gradient"


def gradient(factor: Array) -> Array:
    """Return the gradient of each flight's sum of squares by its own factors, (12, flights)."""

    def loss(factor: Array) -> Array:
        squares = [jnp.sum(leaf * leaf) for leaf in jax.tree.leaves(fly(factor, samples=SAMPLES))]
        return sum(squares, jnp.zeros(()))

    slope: Array = jax.grad(loss)(factor)
    return slope


def main(what: str) -> None:
    if what == GRADIENT:
        factor = factors(REVERSED)
        run = jax.jit(gradient).lower(factor).compile()
        memory = run.memory_analysis()
        assert memory is not None
        answer(
            lambda: jax.block_until_ready(run(factor)),
            REVERSED / FLIGHTS,
            f"{memory.temp_size_in_bytes}",
        )
        return
    kernel, own = Kernel(moves=what == JACOBIAN), np.asarray(factors(FLIGHTS))
    answer(lambda: kernel(own, samples=SAMPLES), 1.0)


if __name__ == "__main__":
    main(sys.argv[1])

"""Forward, Jacobian and gradient of 64 flights: ``... contestants.derivatives jacobian``."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial

from benchmarks.timing import answer
from tuner import runtime

runtime.configure()

import jax  # noqa: E402 (after the set-up)
import jax.numpy as jnp  # noqa: E402
from jax import Array  # noqa: E402

from benchmarks.case import COEFFICIENTS, factors, fly  # noqa: E402
from sim_jax.rigid_body import Motion  # noqa: E402
from tuner.parallel import in_pieces, piece_that_fits, shared_among  # noqa: E402

FLIGHTS, SAMPLES = 64, 2000
FORWARD, JACOBIAN, GRADIENT = "forward", "jacobian", "gradient"


def jacobian_of(function: Callable[[Array], Motion], factor: Array) -> Motion:
    """Return the logged motion's derivatives by 12 shared factors, (samples, 12, flights)."""

    def push(direction: Array) -> Motion:
        moved: Motion = jax.jvp(
            lambda shared: function(factor * shared[:, None]),
            (jnp.ones(COEFFICIENTS),),
            (direction,),
        )[1]
        return moved

    pushed: Motion = jax.vmap(push, out_axes=-2)(jnp.eye(COEFFICIENTS))
    return pushed


flight = partial(fly, samples=SAMPLES)
jacobian = partial(jacobian_of, flight)
"""Of a batch that fits the cache."""
large_jacobian = partial(
    jacobian_of,
    partial(flight, arranged=partial(in_pieces, piece=piece_that_fits(8, COEFFICIENTS))),
)
"""Of any batch: a piece of it flies from one sample to the next, then the other pieces do."""


def gradient(factor: Array) -> Array:
    """Return the gradient of each flight's sum of squares by its own factors, (12, flights)."""

    def loss(factor: Array) -> Array:
        squares = [jnp.sum(leaf * leaf) for leaf in jax.tree.leaves(flight(factor))]
        return sum(squares, jnp.zeros(()))

    slope: Array = jax.grad(loss)(factor)
    return slope


def main(what: str) -> None:
    piece = piece_that_fits(8)
    function = {
        FORWARD: in_pieces(flight, piece),
        JACOBIAN: large_jacobian,
        # a quarter of what fits the cache going forward: reverse mode remembers more
        GRADIENT: in_pieces(gradient, piece // 4),
    }[what]
    factor = factors(FLIGHTS)
    run = jax.jit(shared_among(function, len(jax.devices()))).lower(factor).compile()
    memory = run.memory_analysis()
    assert memory is not None
    answer(
        lambda: jax.block_until_ready(run(factor)),
        1.0,
        f"{memory.temp_size_in_bytes} {memory.output_size_in_bytes}",
    )


if __name__ == "__main__":
    main(sys.argv[1])

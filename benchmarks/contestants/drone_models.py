"""drone-models, first principles, dynamics alone, Euler: ``... contestants.drone_models 4096``."""

from __future__ import annotations

import sys

import jax
import jax.numpy as jnp
from drone_models.core import parametrize
from drone_models.first_principles import dynamics

from benchmarks.timing import answer

STEP = 1e-3


def main(vehicles: int) -> None:
    model = parametrize(dynamics, "cf2x_L250", xp=jnp)
    command = jnp.full((vehicles, 4), 15_000.0)

    def step(state, _):  # type: ignore[no-untyped-def]
        position, attitude, velocity, rate, rotors = state
        moved, turned, pulled, twisted, sped = model(
            position, attitude, velocity, rate, command, rotors
        )
        attitude = attitude + STEP * turned
        attitude = attitude / jnp.linalg.norm(attitude, axis=-1, keepdims=True)
        return (
            position + STEP * moved,
            attitude,
            velocity + STEP * pulled,
            rate + STEP * twisted,
            rotors + STEP * sped,
        ), None

    steps = max(200, min(20_000, 1_500_000 // vehicles))
    zero, upright = (
        jnp.zeros((vehicles, 3)),
        jnp.tile(jnp.array([0.0, 0.0, 0.0, 1.0]), (vehicles, 1)),
    )
    start = (zero, upright, zero, zero, command)
    run = jax.jit(lambda state: jax.lax.scan(step, state, length=steps)[0])
    answer(lambda: jax.block_until_ready(run(start)), vehicles * steps, "float32, dynamics alone")


if __name__ == "__main__":
    main(int(sys.argv[1]))

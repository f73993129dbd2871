"""This project's rollout: ``python -m benchmarks.contestants.ours float32 4096``."""

from __future__ import annotations

import sys
from functools import partial

import numpy as np

from benchmarks.timing import answer
from tuner import runtime

runtime.configure()

import jax  # noqa: E402 (after the set-up)

from benchmarks.case import STEPS, factors, fly  # noqa: E402
from tuner.parallel import in_pieces, piece_that_fits, shared_among  # noqa: E402

WORK = 8_000_000
"""vehicle-steps a run, at least a tenth of a second."""


def main(precision: str, vehicles: int) -> None:
    samples = max(100, min(20_000, WORK // (vehicles * STEPS)))
    flight = partial(fly, samples=samples, precision=precision)
    if vehicles == 1:
        alone, factor = jax.jit(flight), factors(1)[:, 0]
        answer(lambda: jax.block_until_ready(alone(factor)), samples * STEPS, runtime.describe())
        return
    piece = piece_that_fits(np.dtype(precision).itemsize)
    batch = jax.jit(shared_among(in_pieces(flight, piece), len(jax.devices())))
    factor = np.asarray(factors(vehicles))
    answer(
        lambda: jax.block_until_ready(batch(factor)), vehicles * samples * STEPS, runtime.describe()
    )


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))

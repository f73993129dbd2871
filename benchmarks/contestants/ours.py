"""This project's kernel: ``python -m benchmarks.contestants.ours float32 4096``."""

from __future__ import annotations

import sys

import numpy as np

from benchmarks.timing import answer
from tuner.core import runtime

runtime.configure()

from benchmarks.case import STEPS, Kernel, factors  # noqa: E402 (after the set-up)

WORK = 8_000_000
"""vehicle-steps a run, at least a tenth of a second."""


def main(precision: str, vehicles: int) -> None:
    samples = max(100, min(20_000, WORK // (vehicles * STEPS)))
    kernel, factor = Kernel(precision), np.asarray(factors(vehicles))
    answer(
        lambda: kernel(factor, samples=samples),
        vehicles * samples * STEPS,
        f"{precision}, a thread a core, log on the host",
    )


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))

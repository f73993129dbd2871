"""Seconds to trace and to build, nothing kept: ``... contestants.compilation jacobian``."""

from __future__ import annotations

import sys
import time

from tuner.core import runtime

runtime.configure(keep_compiled=False)

import jax  # noqa: E402 (after the set-up)

from benchmarks.case import Kernel, factors  # noqa: E402
from benchmarks.contestants.derivatives import GRADIENT, JACOBIAN, gradient  # noqa: E402


def main(what: str) -> None:
    began = time.perf_counter()
    if what == GRADIENT:
        lowered = jax.jit(gradient).lower(factors(8))
        traced = time.perf_counter()
        lowered.compile()
    else:
        program = Kernel(moves=what == JACOBIAN).program
        _ = program._traced
        traced = time.perf_counter()
        assert program.is_kernel
    print(traced - began, time.perf_counter() - traced)


if __name__ == "__main__":
    main(sys.argv[1])

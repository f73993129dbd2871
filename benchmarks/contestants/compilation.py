"""Seconds to trace and to compile, nothing kept: ``... contestants.compilation jacobian``."""

from __future__ import annotations

import sys
import time

from tuner import runtime

runtime.configure(keep_compiled=False)

import jax  # noqa: E402 (after the set-up)

from benchmarks.case import factors  # noqa: E402
from benchmarks.contestants.derivatives import FORWARD, flight, gradient, jacobian  # noqa: E402


def main(what: str) -> None:
    function = {FORWARD: flight, "jacobian": jacobian, "gradient": gradient}[what]
    began = time.perf_counter()
    lowered = jax.jit(function).lower(factors(8))
    traced = time.perf_counter()
    lowered.compile()
    print(traced - began, time.perf_counter() - traced)


if __name__ == "__main__":
    main(sys.argv[1])

"""Time by the number of flights, their length, and the size of a population."""

from __future__ import annotations

import statistics
import time

import numpy as np

from benchmarks.table import Section, figure
from tuner.core import runtime

REPEATS = 3


def measure() -> Section:
    """Time Jacobians of growing jobs, and populations flown forward."""
    runtime.configure()
    from benchmarks.case import Kernel, factors  # noqa: PLC0415 (after the set-up)

    forward, jacobian = Kernel(), Kernel(moves=True)

    def row(what: str, kernel: Kernel, vehicles: int, length: int) -> list[str]:
        factor, samples = np.asarray(factors(vehicles)), 100 * length
        kernel(factor, samples=samples)
        times = []
        for _ in range(REPEATS):
            began = time.perf_counter()
            kernel(factor, samples=samples)
            times.append(time.perf_counter() - began)
        took = statistics.median(times)
        return [what, figure(took), figure(took / vehicles / length * 1e3)]

    rows = [
        *(row(f"Jacobian, {n} flights of 5 s", jacobian, n, 5) for n in (16, 64, 256)),
        *(row(f"Jacobian, 16 flights of {s} s", jacobian, 16, s) for s in (5, 20, 80)),
        *(row(f"population of {n}, 5 s", forward, n, 5) for n in (64, 512, 4096)),
    ]
    return Section(
        "Scaling",
        "Median seconds of the yardstick's loop rates in float64, and milliseconds for each second "
        "that one vehicle flies, which would stay the same if time grew in proportion; kernels, a "
        "thread a core.",
        ["", "s", "ms a flown second"],
        rows,
    )

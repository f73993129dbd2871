"""Seconds to build programs, with nothing kept from earlier."""

from __future__ import annotations

import subprocess
import sys

from benchmarks.table import Bar, Section, seconds
from benchmarks.timing import ROOT, Spread, environment

REPEATS = 2


def measure() -> Section:
    """Compile in fresh processes."""
    rows, compiled = [], {}
    for what in ("forward", "jacobian", "gradient"):
        pairs = []
        for _ in range(REPEATS):
            done = subprocess.run(
                [sys.executable, "-m", "benchmarks.contestants.ours", "build", what],
                capture_output=True,
                text=True,
                check=True,
                cwd=ROOT,
                env=environment({"JAX_ENABLE_COMPILATION_CACHE": "false"}),
            )
            pairs.append([float(word) for word in done.stdout.split()])
        traced, compiled[what] = (Spread.of([pair[i] for pair in pairs]) for i in (0, 1))
        rows.append([what, seconds(traced), seconds(compiled[what])])
    return Section(
        "Building programs",
        "Seconds in a fresh process with nothing kept: what jax traces in Python, then what is "
        "written as LLVM IR and compiled. The gradient, in reverse mode, is compiled by XLA. The "
        "cache in the user's folder spares the compiling from the second run on.",
        ["", "trace", "build"],
        rows,
        [
            Bar("build, forward", compiled["forward"].median, 1, "at most", " s"),
            Bar("build, Jacobian", compiled["jacobian"].median, 3, "at most", " s"),
        ],
    )

"""Iterations of a fit to many simulated flights: ``... contestants.large 200``."""

from __future__ import annotations

import resource
import sys
import time
from dataclasses import replace

from tuner.core import runtime

runtime.configure()

import jax  # noqa: E402 (after the set-up)
import numpy as np  # noqa: E402

from benchmarks.calibration import problem  # noqa: E402
from benchmarks.oracle import simulate_like  # noqa: E402
from tuner.objective.criterion import Point  # noqa: E402
from tuner.objective.normal_equations import Objective  # noqa: E402
from tuner.search.optimisers import advance, initial_step  # noqa: E402
from tuner.search.progress import criterion_of, initial_progress  # noqa: E402
from tuner.search.stages import plan  # noqa: E402

DURATION = 40.0
"""s of each flight."""
COEFFICIENTS = 20
MORE_TERMS = ("center_of_mass_z", "flapping_moment_coefficient")
START_DISTANCE = 1e-3
"""Of the search from the truth, in its own coordinates."""
ITERATIONS = 3
"""The first is warmed up by."""


def flights(count: int) -> Objective:
    """Return a problem of so many flights: the reference flights' plan, each with its own noise."""
    objective = problem(terms=True, more=MORE_TERMS)
    assert len(objective.space) == COEFFICIENTS
    which = np.arange(count) % objective.segments.count
    segments = jax.tree.map(lambda leaf: np.asarray(leaf)[..., which], objective.segments)
    segments = replace(segments, flight=np.arange(count))
    samples = round(DURATION * objective.schedule.log_rate)
    many = replace(objective, segments=segments, samples=samples)
    flown = simulate_like(many, many.space.initial, np.random.default_rng(0), gusts=False)
    if flown is None:
        raise SystemExit("a flight at the initial coefficients crashed")
    return flown


def main(count: int) -> None:
    objective = flights(count)
    stage = plan(
        "gradient",
        objective.samples,
        float(objective.schedule.log_rate),
        windows=False,
        robust=True,
        steps=ITERATIONS,
    )[-1]
    progress = initial_progress(objective, objective.space.initial[None] + START_DISTANCE)
    criterion = criterion_of(stage, progress.scales, np.asarray(progress.points.offsets[0]), None)
    points: Point = progress.points
    free = np.ones(len(objective.space) + points.offsets[0].size, bool)
    step, times = initial_step(points), []
    for _ in range(ITERATIONS):
        began = time.process_time()
        step = advance(objective, step, criterion, free)
        times.append(time.process_time() - began)
    memory = 1024.0 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print(min(times[1:]), memory)


if __name__ == "__main__":
    main(int(sys.argv[1]))

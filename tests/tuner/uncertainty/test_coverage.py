"""Over repeats with different noise the 95 % intervals cover the truth as often as they should."""

import numpy as np
import pytest

from tests.tuner.uncertainty.making import fitted_of, problem, truth, with_data
from tuner.objective.criterion import Point, picked
from tuner.objective.segments import OFFSETS
from tuner.search.continuation import run_stages
from tuner.search.progress import initial_progress
from tuner.search.stages import plan
from tuner.uncertainty.estimates import uncertainty_of

FREE = (
    "inertia_xx",
    "inertia_yy",
    "inertia_zz",
    "input_scaling",
    "time_constant_up",
    "time_constant_down",
    "motor_constant",
    "moment_constant",
    "rotor_drag_coefficient",
    "estimate_latency",
)
REPEATS = 20


@pytest.mark.slow
def test_intervals_cover_the_truth():
    exact = problem(FREE)
    right = exact.space.numbers(exact.space.initial)
    stages = plan("gradient", exact.samples, 200.0, windows=False, robust=True, steps=20)[-3:]
    free = Point(np.ones(len(FREE), bool), np.zeros((len(OFFSETS), 2), bool))
    covered = np.zeros((REPEATS, len(FREE)), bool)
    for repeat in range(REPEATS):
        noisy = with_data(exact, truth(exact), noise=np.random.default_rng(100 + repeat))
        progress = initial_progress(noisy, np.asarray(exact.space.initial)[None] + 0.02)
        progress = run_stages(
            noisy, stages, progress, free=free, undecided={}, on_progress=lambda _: None
        )
        uncertainty = uncertainty_of(fitted_of(noisy, picked(progress.points, 0)))
        for number, name in enumerate(FREE):
            low, high = uncertainty.estimates[name].ci95
            covered[repeat, number] = low <= float(right[name]) <= high
    share = covered.mean()
    assert 0.85 <= share <= 1.0, covered.mean(axis=0)
    assert covered.mean(axis=0).min() >= 0.7, dict(zip(FREE, covered.mean(axis=0), strict=True))

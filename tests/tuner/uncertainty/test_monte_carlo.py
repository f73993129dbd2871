"""Errors against the spread of fits to fifty noisy recordings of the same flights."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from tests.tuner.uncertainty import making
from tuner.objective.criterion import Point
from tuner.objective.normal_equations import Objective
from tuner.search.optimisers import advance, initial_step
from tuner.uncertainty.estimates import uncertainty_of

FREE = ("inertia_xx", "input_scaling", "motor_constant", "moment_constant")
REFITS = 50
EXAMINED = 5
ITERATIONS = 3


def refit(objective: Objective, start: Point) -> Point:
    criterion = making.criterion_of(objective, prior=0.01)
    offsets = np.asarray(start.offsets)
    free = np.concatenate([np.ones(len(objective.space)), np.zeros(offsets.size)])
    points = Point(np.asarray(start.coefficients)[None], offsets[None])
    step = initial_step(points)
    for _ in range(ITERATIONS):
        step = advance(objective, step, criterion, free)
    return Point(jnp.asarray(step.point.coefficients[0]), jnp.asarray(offsets))


@pytest.mark.long
@pytest.mark.slow
def test_standard_errors_are_the_spread_of_refits() -> None:
    exact = making.problem(FREE)
    truth, noise = making.truth(exact), np.random.default_rng(5)
    fits, noise_alone, quoted = [], [], []
    for number in range(REFITS):
        noisy = making.with_data(exact, truth, noise=noise)
        point = refit(noisy, truth)
        fits.append(np.asarray(noisy.space.scaled(point.coefficients)))
        if number < EXAMINED:
            estimates = uncertainty_of(making.fitted_of(noisy, point)).estimates
            known = [estimates[name] for name in FREE]
            noise_alone.append([one.parts.noise / one.value for one in known])
            quoted.append([one.std_error / one.value for one in known])
    spread = np.std(fits, axis=0, ddof=1)
    assert np.median(noise_alone, axis=0) == pytest.approx(spread, rel=0.3)
    # twelve seconds, three degrees of freedom, leave open how much larger the error may be
    wider = np.median(quoted, axis=0) / spread
    assert np.all(wider > 0.8), wider
    assert np.all(wider < 1.8), wider
    # and they scatter about the truth
    true = np.asarray(exact.space.scaled(truth.coefficients))
    assert np.all(np.abs(np.mean(fits, axis=0) - true) < 3.5 * spread / np.sqrt(REFITS))

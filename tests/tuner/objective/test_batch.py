"""Many vectors at once against one after the other."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from tests.tuner.uncertainty.making import criterion_of, problem
from tuner.objective.criterion import Point
from tuner.objective.normal_equations import VECTORS_AT_ONCE, evaluate

FREE = ("inertia_xx", "time_constant_up", "motor_constant", "estimate_latency")


@pytest.fixture(scope="module")
def fit():
    return problem(FREE)


def test_each_vector_of_a_batch_gives_the_same_as_alone(fit):
    criterion = replace(criterion_of(fit), huber=2.0)
    steps = np.random.default_rng(1).normal(0.0, 0.2, (VECTORS_AT_ONCE + 1, len(FREE)))
    vectors = np.asarray(fit.space.initial) + steps
    late = jnp.full((5, 2), 0.1)
    batch = evaluate(fit, vectors, Point(jnp.asarray(vectors[0]), late), criterion)
    assert batch.loss.shape == (VECTORS_AT_ONCE + 1, 2)
    for number in (0, 3, VECTORS_AT_ONCE):
        alone = fit.sums(Point(jnp.asarray(vectors[number]), late), criterion, derivatives=False)
        np.testing.assert_allclose(batch.loss[number], alone.loss, rtol=1e-9)
        for name, squares in alone.squares.items():
            np.testing.assert_allclose(batch.squares[name][number].sum(axis=0), squares, rtol=1e-9)

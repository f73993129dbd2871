"""Reverse mode against the gradient that forward mode gives, and what it remembers."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.tuner.objective.reverse_mode import gradients
from tests.tuner.uncertainty.making import criterion_of, problem
from tuner.objective.criterion import Point

FREE = ("inertia_xx", "time_constant_up", "motor_constant", "estimate_latency")


@pytest.fixture(scope="module")
def fit():
    return problem(FREE)


@pytest.mark.long  # as `tests.sim_jax.test_rollout_derivatives` shows of a flight alone
@pytest.mark.slow
def test_reverse_mode_gives_forward_modes_gradient(fit):
    criterion = eqx.tree_at(lambda s: s.huber, criterion_of(fit), jnp.asarray(2.0))
    late = jnp.full((5, 2), 0.1)
    steps = np.random.default_rng(1).normal(0.0, 0.2, (3, len(FREE)))
    vectors = np.asarray(fit.space.initial) + steps
    backwards = gradients(fit, vectors, Point(jnp.asarray(vectors[0]), late), criterion)
    assert backwards.gradient.shape == (len(FREE), 3)
    for number, vector in enumerate(vectors):
        sums = fit.sums(Point(jnp.asarray(vector), late), criterion)
        np.testing.assert_allclose(backwards.loss[number], np.sum(sums.loss), rtol=1e-9)
        forward = np.sum(sums.gradient, axis=-1)[: len(FREE)]
        np.testing.assert_allclose(
            backwards.gradient[:, number], forward, rtol=1e-6, atol=1e-8 * np.abs(forward).max()
        )


def test_segments_give_the_same_sums_one_at_a_time_as_many_at_once(fit):
    """Few fly one at a time, and so do those that the memory does not hold at once."""
    which = np.arange(8 * len(jax.devices())) % fit.segments.count
    segments = jax.tree.map(lambda leaf: np.asarray(leaf)[..., which], fit.segments)
    many = replace(fit, segments=replace(segments, flight=np.arange(len(which))))
    small = replace(many, memory=1)
    point = many.start(np.asarray(many.space.initial))
    data = many.data(point.offsets, criterion_of(many))
    few = fit.data(fit.start(fit.space.initial).offsets, criterion_of(fit))
    assert many.simulator.segments_at_once(data, len(FREE)) > 1
    assert small.simulator.segments_at_once(data, len(FREE)) == 1
    assert fit.simulator.segments_at_once(few, len(FREE)) == 1
    want = many.sums(point, criterion_of(many))
    got = small.sums(point, criterion_of(small))
    np.testing.assert_allclose(got.hessian, want.hessian, rtol=1e-12)
    np.testing.assert_allclose(got.loss, want.loss, rtol=1e-12)

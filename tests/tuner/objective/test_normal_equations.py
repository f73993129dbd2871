"""Gradient and Hessian against finite differences, on two short simulated flights."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from tests.tuner.uncertainty.making import criterion_of, problem, truth, with_data
from tuner.objective.criterion import OFFSET_UNIT, Point
from tuner.objective.normal_equations import normal_equations

FREE = ("inertia_xx", "time_constant_up", "motor_constant", "estimate_latency")


@pytest.fixture(scope="module")
def fit():
    return problem(FREE)


def loss_at(fit, coefficients, offsets, criterion):
    point = Point(jnp.asarray(coefficients), jnp.asarray(offsets))
    sums = fit.sums(point, criterion, derivatives=True)
    return normal_equations(fit, point, criterion, sums)


def test_gradient_equals_finite_differences(fit):
    criterion = criterion_of(fit)
    at = np.asarray(fit.space.initial) + 0.1
    late = np.full((5, 2), 0.05)
    _, gradient, _ = loss_at(fit, at, late, criterion)
    for index in range(len(at)):
        step = np.zeros_like(at)
        step[index] = 1e-5
        up, _, _ = loss_at(fit, at + step, late, criterion)
        down, _, _ = loss_at(fit, at - step, late, criterion)
        assert float(gradient[index]) == pytest.approx(float(up - down) / 2e-5, rel=2e-3, abs=1e-8)


def test_offset_gradient_equals_finite_differences(fit):
    criterion = criterion_of(fit)
    at = np.asarray(fit.space.initial)
    late = np.full((5, 2), 0.03)
    _, gradient, _ = loss_at(fit, at, late, criterion)
    by_offset = gradient[len(at) :].reshape(5, 2)
    step = np.zeros((5, 2))
    step[0, 0] = 1e-4
    up, _, _ = loss_at(fit, at, late + step, criterion)
    down, _, _ = loss_at(fit, at, late - step, criterion)
    assert float(by_offset[0, 0]) == pytest.approx(float(up - down) / 2e-4, rel=1e-2)


def test_the_truth_has_no_residual_and_no_gradient(fit):
    criterion = criterion_of(fit, prior=0.0)
    point = truth(fit)
    sums = fit.sums(point, criterion, derivatives=True)
    assert float(jnp.sum(sums.loss)) < 1e-12
    assert not np.any(np.isfinite(sums.crash_time))


def test_hessian_is_symmetric_and_positive(fit):
    criterion = criterion_of(fit)
    _, _, hessian = loss_at(fit, np.asarray(fit.space.initial), np.zeros((5, 2)), criterion)
    np.testing.assert_allclose(hessian, hessian.T, rtol=1e-12)
    assert np.linalg.eigvalsh(np.asarray(hessian)).min() > 0


def test_a_horizon_cuts_the_compared_samples(fit):
    criterion = criterion_of(fit)
    short = replace(criterion, horizon=400)
    point = Point(jnp.asarray(fit.space.initial + 0.2), jnp.zeros((5, 2)))
    whole = fit.sums(point, criterion, derivatives=True)
    part = fit.sums(point, short, derivatives=True)
    assert float(part.counts["position"][0]) == pytest.approx(
        float(whole.counts["position"][0]) / 3, rel=0.02
    )
    assert float(part.squares["position"][0]) < float(whole.squares["position"][0])


def test_huber_counts_large_residuals_linearly(fit):
    criterion = criterion_of(fit)
    robust = replace(criterion, huber=2.0)
    point = Point(jnp.asarray(fit.space.initial + 0.5), jnp.zeros((5, 2)))
    plain = fit.sums(point, criterion, derivatives=True)
    bounded = fit.sums(point, robust, derivatives=True)
    assert float(jnp.sum(bounded.loss)) < float(jnp.sum(plain.loss))
    assert float(jnp.sum(bounded.squares["position"])) == pytest.approx(
        float(jnp.sum(plain.squares["position"]))
    )


def test_a_late_clock_is_found_in_its_own_column(fit):
    late = Point(truth(fit).coefficients, jnp.zeros((5, 2)).at[:2].set(0.02 / OFFSET_UNIT))
    shifted = with_data(fit, truth(fit))
    moved = eqx.tree_at(
        lambda o: [m.time for m in o.segments.measured.values()],
        shifted,
        [m.time + 0.02 for m in shifted.segments.measured.values()],
    )
    criterion = criterion_of(fit, prior=0.0)
    with_offset = moved.sums(late, criterion, derivatives=True)
    without = moved.sums(truth(fit), criterion, derivatives=True)
    assert float(jnp.sum(with_offset.loss)) < 1e-3 * float(jnp.sum(without.loss))


def test_a_flight_on_which_the_vehicle_tumbles_has_a_loss_and_no_slope(fit):
    """Derivatives grow a million millionfold there, and would be all that a step goes by."""
    values, criterion = fit.space.numbers(fit.space.initial), criterion_of(fit)
    values["inertia_xx"] *= 0.1
    light, flies, tumbles = fit.start(fit.space.vector_of(values)), 0, 1
    columns = fit.jacobian(light, criterion).columns["body_rate"]
    assert np.abs(columns[..., tumbles]).max() > 1e8
    sums = fit.sums(light, criterion)
    assert sums.loss[tumbles] > 0.0
    assert not sums.gradient[:, tumbles].any()
    assert not sums.hessian[..., tumbles].any()
    assert sums.gradient[:, flies].any()

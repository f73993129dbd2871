"""The growing horizon on two short simulated flights whose truth is known."""

from itertools import pairwise

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.tuner.uncertainty.making import problem
from tuner.objective.criterion import Point, picked
from tuner.objective.normal_equations import normal_equations, sums_at
from tuner.objective.segments import OFFSETS
from tuner.search import continuation, optimisers
from tuner.search.continuation import _clocks_that_differ, run_stages
from tuner.search.progress import criterion_of, initial_progress
from tuner.search.stages import schedule_of

FREE = ("inertia_xx", "inertia_zz", "time_constant_up", "motor_constant", "input_scaling")


@pytest.fixture(scope="module")
def fit():
    return problem(FREE, seed=5)


def searched(fit, vectors, *, offsets=False):
    stages = schedule_of(fit.samples, fit.schedule.log_rate, robust=True, steps=30)
    reports = []
    free = Point(np.ones(len(fit.space), bool), np.full((len(OFFSETS), 2), offsets))
    progress = initial_progress(fit, np.asarray(vectors))
    progress = run_stages(
        fit, stages, progress, free=free, undecided={}, on_progress=reports.append
    )
    return progress, reports


def test_truth_is_recovered_from_every_start(fit):
    wrong = {"inertia_xx": 1.5, "inertia_zz": 0.7, "time_constant_up": 1.6, "motor_constant": 0.8}
    values = fit.space.numbers(fit.space.initial)
    starts = [
        fit.space.vector_of({n: float(v) * wrong.get(n, 1.0) ** sign for n, v in values.items()})
        for sign in (1, -1)
    ]
    progress, reports = searched(fit, starts)
    for start in range(2):
        fitted = fit.space.numbers(progress.points.coefficients[start])
        for name, value in values.items():
            assert float(fitted[name]) == pytest.approx(float(value), rel=0.02), (start, name)
    assert progress.converged
    assert len(reports) == progress.evaluations
    assert reports[-1].iterations[-1].stage == "polish again"


def test_a_flight_of_noise_is_weighed_down_and_the_others_are_fitted(fit):
    noise = np.random.default_rng(6)
    spoilt = {}
    for name, measured in fit.segments.measured.items():
        values = np.array(measured.values)
        values[..., 1] += (
            noise.normal(size=values[..., 1].shape) * 300.0 / np.array(measured.weight).max()
        )
        spoilt[name] = eqx.tree_at(lambda m: m.values, measured, jnp.asarray(values))
    poisoned = eqx.tree_at(lambda o: o.segments.measured, fit, spoilt)
    progress, _ = searched(poisoned, [np.asarray(fit.space.initial) + 0.1])
    assert min(float(scale[1]) for scale in progress.scales.values()) > 10
    fitted = fit.space.numbers(progress.points.coefficients[0])
    true = fit.space.numbers(fit.space.initial)
    assert float(fitted["inertia_xx"]) == pytest.approx(float(true["inertia_xx"]), rel=0.05)
    assert float(fitted["motor_constant"]) == pytest.approx(float(true["motor_constant"]), rel=0.01)


def test_the_same_search_twice_gives_the_same_numbers(fit):
    start = [np.asarray(fit.space.initial) + 0.1]
    first, _ = searched(fit, start)
    second, _ = searched(fit, start)
    np.testing.assert_array_equal(first.points.coefficients, second.points.coefficients)


def test_the_search_ends_within_a_tenth_of_a_standard_error_of_the_minimum(fit):
    stage, reports = schedule_of(fit.samples, 1.0, robust=True, steps=30)[-1], []
    free = Point(np.ones(len(fit.space), bool), np.zeros((len(OFFSETS), 2), bool))
    start = initial_progress(fit, np.asarray(fit.space.initial)[None] + 0.02)
    progress = run_stages(fit, (stage,), start, free=free, undecided={}, on_progress=reports.append)
    last = reports[-1]
    iterate = last.iterate
    assert iterate.accepted[0]
    assert progress.points is iterate.points  # what it ends with was flown
    point, here = picked(iterate.points, 0), jax.tree.map(lambda leaf: leaf[0], iterate.sums)
    criterion = criterion_of(stage, last.scales, np.asarray(point.offsets))
    count = len(fit.space)
    _, gradient, hessian = normal_equations(fit, point, criterion, here)
    compared = sum(float(np.sum(n)) for n in here.counts.values())
    gradient, hessian = np.asarray(gradient)[:count], np.asarray(hessian)[:count, :count]
    away = np.sqrt(compared * gradient @ np.linalg.solve(hessian, gradient))
    assert away <= 0.1


def test_no_point_is_flown_twice_where_clocks_are_looked_at(fit, monkeypatch):
    flown, looked_at = [], []

    def recorded(objective, points, criterion, *, derivatives=True):
        if derivatives:
            numbers = (points, criterion.scale, criterion.horizon, criterion.huber)
            flown.append(tuple(np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(numbers)))
        return sums_at(objective, points, criterion, derivatives=derivatives)

    def judged(*given):
        looked_at.append(_clocks_that_differ(*given))
        return looked_at[-1]

    for module in (continuation, optimisers):
        monkeypatch.setattr(module, "sums_at", recorded)
    monkeypatch.setattr(continuation, "_clocks_that_differ", judged)
    late = {
        name: eqx.tree_at(lambda m: m.time, measured, measured.time + np.array([0.0, 0.02]))
        for name, measured in fit.segments.measured.items()
    }
    differing = eqx.tree_at(lambda o: o.segments.measured, fit, late)
    searched(differing, [np.asarray(fit.space.initial) + 0.1], offsets=True)
    assert len(looked_at) == 2
    assert looked_at[-1][0, 1]  # it stays late
    assert len(set(flown)) == len(flown)


def test_a_stage_begins_with_the_trust_that_the_last_one_earned(fit):
    progress, _ = searched(fit, [np.asarray(fit.space.initial) + 0.1])
    pairs = list(pairwise(progress.iterations))
    borders = [(old, new) for old, new in pairs if old.stage != new.stage]
    assert len(borders) > 3
    for old, new in borders:
        assert new.damping == pytest.approx(min(old.damping, 1.0)) or new.damping == 1.0, new.stage
    assert borders[-1][1].damping < 1e-2

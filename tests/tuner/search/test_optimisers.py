"""Levenberg-Marquardt on a valley of its own, flown by nobody; CMA-ES on simulated flights."""

from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from tests.tuner.uncertainty.making import problem
from tuner.objective.criterion import Point
from tuner.objective.normal_equations import NormalEquations
from tuner.objective.segments import OFFSETS
from tuner.search import optimisers
from tuner.search.continuation import run_stages
from tuner.search.optimisers import MATCHED_RATIO, advance, initial_step
from tuner.search.progress import initial_progress
from tuner.search.stages import Stage, plan

END = np.array([1.0, 1.0])
START = np.array([-1.2, 1.0])


def valley(vector):
    """Rosenbrock's: residuals 10 (y - x²) and 1 - x."""
    x, y = vector
    residual = np.array([10.0 * (y - x * x), 1.0 - x])
    slope = np.array([[-20.0 * x, 10.0], [-1.0, 0.0]])
    return NormalEquations(0.5 * residual @ residual, slope.T @ residual, slope.T @ slope)


@pytest.fixture
def advanced(monkeypatch):
    """Steps in the valley, of several starts; ``differentiated`` has the points that were."""
    differentiated = []

    def flown(_, points, __, *, derivatives=True, **___):
        if derivatives:
            differentiated.append(points)
        return points

    monkeypatch.setattr(optimisers, "sums_at", flown)
    monkeypatch.setattr(
        optimisers,
        "normal_equations",
        lambda _, tried, __, ___: valley(tried.coefficients),
    )

    def steps(points, count, *, free=(1.0, 1.0), damping=None, unknown=0, windowed=False):
        segments = SimpleNamespace(windowed=windowed)
        objective = SimpleNamespace(space=range(2), segments=segments, flight=np.zeros(1, int))
        criterion = SimpleNamespace(states=np.zeros((unknown, 1)) if unknown else None)
        found = [initial_step(Point(np.asarray(points), np.zeros((len(points), 0, 1))), damping)]
        for _ in range(count):
            found.append(advance(objective, found[-1], criterion, np.array(free)))
        return found

    steps.differentiated = differentiated
    return steps


def test_a_point_that_is_rejected_is_not_differentiated_where_flights_cost_less(advanced):
    found = {}
    for unknown in (0, 1):
        del advanced.differentiated[:]
        found[unknown] = advanced([START], 12, damping=np.array([1e-9]), unknown=unknown)
        accepted = sum(bool(step.accepted[0]) for step in found[unknown][1:])
        assert accepted < 12
        assert len(advanced.differentiated) == (12 if unknown else accepted)
    for first, second in zip(found[0], found[1], strict=True):
        np.testing.assert_array_equal(first.tried.coefficients, second.tried.coefficients)


def test_every_start_reaches_the_minimum_and_stands_still(advanced):
    *_, last = advanced([START, [3.0, -2.0]], 60)
    np.testing.assert_allclose(last.point.coefficients, [END, END], atol=1e-7)
    assert last.stalled.all()
    assert last.predicted_reduction.max() < 1e-9


@pytest.mark.parametrize("windowed", [False, True])
def test_a_loss_that_rises_is_rejected_and_damps_more(advanced, windowed):
    """The more, the shorter the step to the least of a parabola through whole flights' losses."""
    steps = advanced([START], 12, damping=np.array([1e-9]), windowed=windowed)
    for before, after in pairwise(steps[1:]):
        assert after.loss <= before.loss
        if not after.accepted[0]:
            change = (before.tried.coefficients - before.point.coefficients)[0]
            here = valley(before.point.coefficients[0])
            rise = valley(before.tried.coefficients[0]).loss - here.loss
            slope = here.gradient @ change
            share = -slope / (2.0 * (rise - slope))
            grown = 5.0 if windowed else np.clip(1.0 / share, 5.0, 125.0)
            assert after.damping == pytest.approx(grown * before.damping)
            np.testing.assert_array_equal(after.point.coefficients, before.point.coefficients)
    assert not all(step.accepted[0] for step in steps)


def test_the_first_step_is_the_damped_one(advanced):
    _, first = advanced([START], 1, damping=np.array([2.0]))
    _, gradient, hessian = valley(START)
    expected = START - np.linalg.solve(hessian + 2.0 * np.eye(2), gradient)
    np.testing.assert_allclose(first.tried.coefficients[0], expected, rtol=1e-9)
    gain = 0.5 * gradient @ np.linalg.solve(hessian, gradient)
    assert first.predicted_reduction[0] == pytest.approx(gain / valley(START).loss)
    change = expected - START
    step_reduction = -gradient @ change - 0.5 * change @ hessian @ change
    assert first.step_reduction[0] == pytest.approx(step_reduction / valley(START).loss)


def test_held_parameters_stay(advanced):
    *_, last = advanced([START], 30, free=(0.0, 1.0))
    np.testing.assert_allclose(last.point.coefficients[0], [-1.2, 1.44], atol=1e-9)


def test_a_loss_that_is_no_number_is_never_better(advanced):
    *_, last = advanced([START, [np.nan, 0.0]], 3)
    assert np.isfinite(last.loss[0])
    assert not last.accepted[1]


def ends(last, gain, accepted, worst, *, step_reduction=1.0, tries=1):
    """Return whether a stage ends after so many tries at a loss of 1."""
    stage = SimpleNamespace(tolerance=1e-4, rough=False, target_loss=0.0, far_off_tolerance=0.0)
    segments = SimpleNamespace(windowed=False)
    problem = SimpleNamespace(stage=stage, last=last, objective=SimpleNamespace(segments=segments))
    step = SimpleNamespace(
        predicted_reduction=np.array([gain]),
        step_reduction=np.array([step_reduction]),
        accepted=np.array([accepted]),
        loss=np.array([1.0]),
        stalled=np.array([False]),
        sums=SimpleNamespace(compared=np.array([1000.0])),
    )
    losses = [step.loss] * tries
    return optimisers._has_converged(problem, step, np.array([worst]), losses)


@pytest.mark.parametrize("last", [False, True])
@pytest.mark.parametrize("gain", [0.009, 0.011])
@pytest.mark.parametrize("accepted", [False, True])
@pytest.mark.parametrize("worst", [0.9 * MATCHED_RATIO, 1.1 * MATCHED_RATIO])
def test_a_stage_ends_before_a_small_step_where_the_fit_is_near_and_the_last_was_better(
    last, gain, accepted, worst
):
    ended = ends(last, gain, accepted, worst)
    assert ended is (not last and gain < 0.01 and accepted and worst < MATCHED_RATIO)


@pytest.mark.parametrize("last", [False, True])
@pytest.mark.parametrize("step_reduction", [0.9e-4, 1.1e-4, np.nan])
@pytest.mark.parametrize("tries", [3, 4])
def test_rejected_tries_end_the_last_stage_once_the_next_promises_nothing(
    last, step_reduction, tries
):
    ended = ends(last, 0.1, False, 2.0 * MATCHED_RATIO, step_reduction=step_reduction, tries=tries)
    assert ended is (tries == 4 and not (last and step_reduction > 1e-4))


@pytest.mark.parametrize("far_off", [0.0, 0.1])
@pytest.mark.parametrize("fall", [0.08, 0.12])
@pytest.mark.parametrize("accepted", [False, True])
@pytest.mark.parametrize("worst", [0.9 * MATCHED_RATIO, 1.1 * MATCHED_RATIO])
def test_a_stage_ends_before_its_minimum_where_most_flights_are_far_off(
    far_off, fall, accepted, worst
):
    stage = Stage("first 8 s", 3200, tolerance=1e-4, far_off_tolerance=far_off)
    segments = SimpleNamespace(windowed=False)
    problem = SimpleNamespace(stage=stage, last=False, objective=SimpleNamespace(segments=segments))
    step = SimpleNamespace(
        predicted_reduction=np.array([0.5]),
        step_reduction=np.array([0.5]),
        accepted=np.array([accepted]),
        loss=np.array([1.0]),
        stalled=np.array([False]),
        sums=SimpleNamespace(compared=np.array([1000.0])),
    )
    ended = optimisers._has_converged(
        problem, step, np.array([worst]), [step.loss + fall, step.loss]
    )
    assert ended is (far_off > fall and accepted and worst > MATCHED_RATIO)


# CMA-ES on two short simulated flights whose truth is known

FREE = ("inertia_zz", "motor_constant", "moment_constant")


@pytest.fixture(scope="module")
def fit():
    return problem(FREE, seed=5)


def evolved(fit, *, seed, free=None):
    stage = Stage("CMA-ES", 400, 5.0, False, False, 12, 1e-3, False, False, optimiser="cma")
    free = Point(
        np.ones(len(FREE), bool) if free is None else free, np.zeros((len(OFFSETS), 2), bool)
    )
    start = fit.space.vector_of(
        {
            p.name: p.initial * factor
            for p, factor in zip(fit.space.parameters, (1.4, 0.8, 0.7), strict=True)
        }
    )
    reports = []
    end = run_stages(
        fit,
        (stage,),
        initial_progress(fit, start[None]),
        free=free,
        undecided={},
        on_progress=reports.append,
        seed=seed,
    )
    return start, end, reports


def test_generations_come_closer_to_the_truth(fit):
    start, end, reports = evolved(fit, seed=0)
    thrust = FREE.index("motor_constant")
    off = float(end.points.coefficients[0][thrust]) - fit.space.initial[thrust]
    assert abs(off) < 0.2 * abs(start[thrust] - fit.space.initial[thrust])
    losses = [now.iterations[-1].loss for now in reports]
    assert losses[-1] < 0.2 * losses[0]
    assert losses == sorted(losses, reverse=True)
    assert end.losses[0] == losses[-1]


def test_a_seed_decides_the_numbers(fit):
    _, first, _ = evolved(fit, seed=3)
    _, again, _ = evolved(fit, seed=3)
    _, reseeded, _ = evolved(fit, seed=4)
    np.testing.assert_array_equal(first.points.coefficients, again.points.coefficients)
    assert not np.array_equal(first.points.coefficients, reseeded.points.coefficients)


def test_fixed_parameters_stay(fit):
    free = np.array([True, False, True])
    start, end, _ = evolved(fit, seed=0, free=free)
    vector = np.asarray(end.points.coefficients[0])
    assert vector[1] == pytest.approx(start[1], rel=1e-9)
    assert vector[0] != start[0]


@pytest.mark.parametrize("windows", [True, False])
def test_plans_follow_their_method(windows):
    def optimisers(method):
        stages = plan(method, 4000, 400.0, windows=windows, robust=True, steps=50)
        return [(stage.optimiser, stage.coefficients) for stage in stages]

    assert set(optimisers("gradient")) == {("gradient", True)}
    hybrid = optimisers("hybrid")
    assert hybrid[0] == ("cma", True)
    assert hybrid[-1] == ("gradient", True)
    assert set(optimisers("cma")) == {("cma", True), ("gradient", False)}

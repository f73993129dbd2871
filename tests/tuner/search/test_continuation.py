"""The growing horizon on two short simulated flights whose truth is known."""

import importlib
import sys
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.tuner.uncertainty.making import NOISE, PHYSICS, problem, truth, with_data
from tuner.objective.criterion import OFFSET_UNIT, Point, picked
from tuner.objective.initial_conditions import ROWS, start_sd_of_spin
from tuner.objective.normal_equations import normal_equations, sums_at
from tuner.objective.segments import CLOCK_OF, CLOCKS, OFFSETS, MeasuredChannel
from tuner.search import continuation, optimisers
from tuner.search.continuation import (
    OPTIMISERS,
    SWITCH_GAIN,
    _clocks_that_differ,
    run_stages,
)
from tuner.search.optimisers import MAX_STATE_SD, estimated_states, need_relinearising
from tuner.search.progress import Loop, criterion_of, initial_progress, loop_of, with_loop
from tuner.search.stages import WHOLE_LENGTH, Stage, horizon_stages, plan

FREE = ("inertia_xx", "inertia_zz", "time_constant_up", "motor_constant", "input_scaling")


@pytest.fixture(scope="module")
def fit():
    return problem(FREE, seed=5)


def searched(fit, vectors, *, offsets=False, **given):
    stages = horizon_stages(fit.samples, fit.schedule.log_rate, robust=True, steps=30)
    reports = []
    free = Point(np.ones(len(fit.space), bool), np.full((len(OFFSETS), 2), offsets))
    progress = initial_progress(fit, np.asarray(vectors))
    progress = run_stages(
        fit, stages, progress, free=free, undecided={}, on_progress=reports.append, **given
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
    stage, reports = horizon_stages(fit.samples, 1.0, robust=True, steps=30)[-1], []
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

    def recorded(objective, points, criterion, *, derivatives=True, still=False):
        if derivatives:
            numbers = (points, criterion.scale, criterion.horizon, criterion.huber)
            flown.append(tuple(np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(numbers)))
        return sums_at(objective, points, criterion, derivatives=derivatives, still=still)

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


# an optimiser is added by one function: a stage names it, and so does a search's method

OF_THREE = ("inertia_zz", "motor_constant", "moment_constant")
MODULE = '''
import numpy as np

from tuner.objective.normal_equations import evaluate
from tuner.objective.criterion import OFFSET_UNIT, Point, picked
from tuner.search.continuation import OPTIMISERS
from tuner.search.progress import Iterate


def coordinate_search(problem):
    """Try each coefficient a little higher and lower; halve the step when none helps."""
    width, vector = 0.2, np.asarray(problem.points.coefficients[problem.best])
    while True:
        reach = width * np.eye(len(vector))[problem.free.coefficients]
        tried = np.concatenate([vector[None], vector + reach, vector - reach])
        point = picked(problem.points, problem.best)
        losses = np.asarray(evaluate(problem.objective, tried, point, problem.criterion).loss)
        best = int(np.argmin(losses.sum(axis=-1)))
        width, vector = width if best else 0.5 * width, tried[best]
        yield Iterate(
            points=Point(vector[None], problem.points.offsets),
            losses=np.array([float(losses[best].sum())]),
            accepted=np.array([best > 0]),
            position_rmse=float("nan"),
            converged=width < 1e-3,
        )


OPTIMISERS["coordinate_search"] = coordinate_search
'''


@pytest.fixture
def added(tmp_path, monkeypatch):
    """The name of an optimiser that a module of its own adds."""
    (tmp_path / "coordinate_search.py").write_text(MODULE)
    monkeypatch.syspath_prepend(tmp_path)
    importlib.import_module("coordinate_search")
    yield "coordinate_search"
    del OPTIMISERS["coordinate_search"], sys.modules["coordinate_search"]


def test_an_added_optimiser_runs_the_stages_and_recovers_the_truth(added):
    fit = problem(OF_THREE)
    rate = float(fit.schedule.log_rate)
    stages = plan(added, fit.samples, rate, windows=False, robust=False, steps=40)
    stages = [stage for stage in stages if stage.name in ("first 3 s", WHOLE_LENGTH)]
    reports = []
    start = np.asarray(fit.space.initial) + np.array([0.3, -0.2, 0.0])
    progress = run_stages(
        fit,
        tuple(stages),
        initial_progress(fit, start[None]),
        free=Point(np.array([True, True, False]), np.zeros((len(OFFSETS), 2), bool)),
        undecided={},
        on_progress=reports.append,
    )
    assert {report.iterations[-1].stage for report in reports} == {"first 3 s", WHOLE_LENGTH}
    assert reports[-1].iterate.points is progress.points
    assert progress.points.coefficients[0] == pytest.approx(fit.space.initial, abs=0.01)
    assert all(iteration.damping is None for iteration in progress.iterations)


def test_least_squares_reports_its_damping():
    fit = problem(OF_THREE)
    stage = plan("gradient", fit.samples, 200.0, windows=False, robust=False, steps=3)[3]
    progress = run_stages(
        fit,
        (stage,),
        initial_progress(fit, np.asarray(fit.space.initial)[None] + [[0.05], [0.06]]),
        free=Point(np.ones(len(OF_THREE), bool), np.zeros((len(OFFSETS), 2), bool)),
        undecided={},
        on_progress=lambda _: None,
    )
    first, second, *_ = (iteration.damping for iteration in progress.iterations)
    assert first == 1.0
    assert second == pytest.approx(0.2)  # the model predicted well: five times longer a step


def test_offsets_alone_are_fitted_without_derivatives_by_coefficients(fit, monkeypatch):
    stages = horizon_stages(fit.samples, fit.schedule.log_rate, robust=True, steps=5)[-2:]
    offsets = np.ones((len(OFFSETS), 2), bool)
    asked, sums_of = set(), type(fit).sums

    def spied(objective, *given, **how):
        asked.add((how.get("still", False), how.get("derivatives", True)))
        return sums_of(objective, *given, **how)

    def polished():
        start = initial_progress(fit, np.asarray(fit.space.initial)[None])
        late = replace(start, points=Point(start.points.coefficients, start.points.offsets + 4.0))
        free = Point(np.zeros(len(fit.space), bool), offsets)
        said = {"free": free, "undecided": {}, "on_progress": lambda _: None}
        return run_stages(fit, stages, late, **said)

    monkeypatch.setattr(type(fit), "sums", spied)
    alone = polished()
    assert {how for how in asked if how[1]} == {(True, True)}

    def with_columns(*given, **how):
        return sums_at(*given, **{**how, "still": False})

    for module in (optimisers, continuation):
        monkeypatch.setattr(module, "sums_at", with_columns)
    beside = polished()
    assert (False, True) in asked
    np.testing.assert_array_equal(alone.points.offsets, beside.points.offsets)
    assert np.abs(alone.points.offsets).max() < 2.0  # they went half of the way at least
    np.testing.assert_array_equal(alone.losses, beside.losses)


# what is undecided of the loop is decided by the recordings

FRAME = {"marker_tilt_x": 0.0105, "marker_tilt_y": -0.0157, "motor_constant": 1.5e-5}


@pytest.mark.parametrize("flown", [0.0, 1.0])
@pytest.mark.parametrize("written", [0.0, 1.0])
def test_who_sees_the_markers_is_found_whatever_the_controller_file_says(flown, written):
    free = problem(tuple(FRAME))
    truth = Point(jnp.asarray(free.space.vector_of(FRAME)), free.start(free.space.initial).offsets)
    noise = np.random.default_rng(3)
    recorded = with_data(with_loop(free, Loop(sees_markers=flown)), truth, noise=noise)
    fit = with_loop(recorded, Loop(sees_markers=written))
    progress = run_stages(
        fit,
        horizon_stages(fit.samples, fit.schedule.log_rate, robust=True, steps=10),
        initial_progress(fit, np.asarray(fit.space.initial)[None]),
        free=Point(np.ones(len(fit.space), bool), np.zeros((len(OFFSETS), 2), bool)),
        undecided={"sees_markers": np.ones(2, bool)},
        on_progress=lambda _: None,
    )
    assert progress.loop == Loop(sees_markers=flown)
    assert loop_of(with_loop(fit, progress.loop)).sees_markers == flown
    found = fit.space.numbers(progress.points.coefficients[0])
    for name, value in FRAME.items():
        assert float(found[name]) == pytest.approx(value, rel=0.05)


@pytest.mark.parametrize(("overruled", "chosen"), [((), 0.0), (("sees_markers",), 1.0)])
def test_a_file_that_was_overruled_before_needs_the_smaller_loss(monkeypatch, overruled, chosen):
    def loss(_, problem, *__):
        return 1.0 if loop_of(problem.objective).sees_markers else 0.5 * (1.0 + SWITCH_GAIN)

    monkeypatch.setattr(continuation, "_loss_of", loss)
    fit = problem(tuple(FRAME))
    stages = horizon_stages(fit.samples, fit.schedule.log_rate, robust=True, steps=1)
    at = next(number for number, stage in enumerate(stages) if stage.tries_choices)
    progress = run_stages(
        with_data(fit, fit.start(fit.space.initial)),
        stages[at : at + 1],
        initial_progress(fit, np.asarray(fit.space.initial)[None]),
        free=Point(np.ones(len(fit.space), bool), np.zeros((len(OFFSETS), 2), bool)),
        undecided={"sees_markers": np.ones(2, bool)},
        on_progress=lambda _: None,
        overruled=overruled,
    )
    assert progress.loop.sees_markers == chosen


def test_who_sees_the_markers_is_tried_from_where_the_search_began():
    """By another choice the first seconds lead the markers to where none of them flies."""
    fit = problem(tuple(FRAME))
    stages = horizon_stages(fit.samples, fit.schedule.log_rate, robust=True, steps=2)
    at = next(number for number, stage in enumerate(stages) if stage.tries_choices)
    start = initial_progress(fit, np.asarray(fit.space.initial)[None])
    astray = start.points.coefficients + 3.0
    reports, seen = [], Loop(sees_markers=1.0)
    there = replace(start, stage=at, points=Point(astray, start.points.offsets))
    progress = run_stages(
        with_loop(with_data(with_loop(fit, seen), fit.start(fit.space.initial)), Loop()),
        stages[: at + 1],
        there,
        free=Point(np.ones(len(fit.space), bool), np.zeros((len(OFFSETS), 2), bool)),
        undecided={"sees_markers": np.ones(2, bool)},
        on_progress=reports.append,
        start=start,
    )
    assert progress.loop == seen
    np.testing.assert_allclose(progress.points.coefficients, start.points.coefficients, atol=1e-3)
    for report in reports:  # a checkpoint of them begins with the stage again
        np.testing.assert_array_equal(report.points.coefficients, astray)
        assert (report.stage, report.loop) == (at, start.loop)
        assert len(report.iterations) == report.evaluations == report.steps


@pytest.mark.parametrize("flown", [0.0, 1.0])
def test_saturation_feedback_is_decided_by_the_flights_that_clip(flown):
    """The other was recorded metres away, which takes up most of the loss."""
    fit, turning = problem(("inertia_zz",)), jnp.asarray([0.0, 12.0])
    fit = eqx.tree_at(lambda o: o.segments.inlet.yaw_rate, fit, turning)
    recorded = with_data(with_loop(fit, Loop(flown)), fit.start(fit.space.initial))
    recorded = with_loop(recorded, Loop(1.0 - flown))
    away = np.array([2000.0, 0.0]) * NOISE["position"]
    fit = eqx.tree_at(
        lambda o: o.segments.measured["position"].values, recorded, replace_fn=lambda p: p + away
    )
    stages = horizon_stages(fit.samples, fit.schedule.log_rate, robust=True, steps=4)
    stages = [stage for stage in stages if stage.tries_choices]
    progress = run_stages(
        fit,
        tuple(stages),
        initial_progress(fit, np.asarray(fit.space.initial)[None]),
        free=Point(np.ones(1, bool), np.zeros((len(OFFSETS), 2), bool)),
        undecided={"saturation_feedback": np.array([False, True])},
        on_progress=lambda _: None,
    )
    assert progress.loop.saturation_feedback == flown


LATE = (0.0137, 0.0062)
"""s by which a flight controller's clock is late in each of two flights."""


def with_a_late_flight_controller(fit):
    """Return a fit with commands, and what the flight controller stamps later by `LATE`."""
    stamps = fit.segments.measured["body_rate"].time + 0.3 / PHYSICS
    read, weight = np.zeros((len(stamps), 4, 2)), np.full((len(stamps), 4, 2), 1.0 / 3e-4)
    measured = {**fit.segments.measured, "command": MeasuredChannel(stamps, read, weight)}
    noise = np.random.default_rng(7)
    fit = eqx.tree_at(lambda o: o.segments.measured, fit, measured)
    fit = with_data(fit, truth(fit), noise=noise)
    late = {
        name: eqx.tree_at(lambda m: m.time, of, of.time + CLOCK_OF[name] * np.array(LATE))
        for name, of in fit.segments.measured.items()
    }
    return eqx.tree_at(lambda o: o.segments.measured, fit, late)


def test_a_late_flight_controller_is_found_though_commands_jump():
    fit = with_a_late_flight_controller(problem(FREE))
    begin = [np.asarray(fit.space.initial) + 0.1]
    progress, _ = searched(fit, begin, offsets=True, clocks_are_late=True)
    fitted, true = (
        fit.space.numbers(of) for of in (progress.points.coefficients[0], fit.space.initial)
    )
    for name, value in true.items():
        assert float(fitted[name]) == pytest.approx(float(value), rel=0.01), name
    found = np.asarray(progress.points.offsets)[0, CLOCKS.index("flight_controller")] * OFFSET_UNIT
    np.testing.assert_allclose(found, LATE, atol=3e-4)
    assert max(progress.scales["command"]) < 1.1


# clocks that recordings can do without are right; those that differ from the others stay late

COUNT, POSE = 3, 0
KNOWN, ALONE = 1e4, 10.0
"""Information about latency and clock together, and about each clock by itself."""


def stays(monkeypatch, late):
    """Return which pose clocks stay, of flights whose poses are late by so much at the minimum.

    What is recorded says when the vehicle moved: latency (the one coefficient) and clock together.
    """
    kinds = len(OFFSETS)
    rows = np.zeros((COUNT, 1 + kinds * COUNT))
    rows[:, 0] = 1.0
    rows[np.arange(COUNT), 1 + POSE * COUNT + np.arange(COUNT)] = 1.0
    hessian = KNOWN * rows.T @ rows + ALONE * np.eye(1 + kinds * COUNT)
    monkeypatch.setattr(
        continuation, "normal_equations", lambda *_: (100.0, np.zeros(len(hessian)), hessian)
    )
    objective = SimpleNamespace(space=[None], flights=COUNT, flight=np.arange(COUNT))
    offsets = np.zeros((1, kinds, COUNT))
    offsets[0, POSE] = late
    offsets[0, -1] = 1.0  # a gyro's bias is no clock
    points = Point(jnp.zeros((1, 1)), jnp.asarray(offsets))
    free = Point(np.ones(1, bool), np.ones(offsets.shape[1:], bool))
    problem = SimpleNamespace(objective=objective, points=points, criterion=None, free=free)
    stay = continuation._clocks_that_differ(problem, 0, np.zeros(1))
    assert stay[2:].all()
    return stay[POSE].tolist()


@pytest.mark.parametrize(
    ("late", "stay"),
    [
        ((0.0, 0.0, 0.0), [False, False, False]),
        ((0.2, 0.2, 0.2), [False, False, False]),  # latency explains it as well
        ((0.2, 0.2, 0.5), [False, False, True]),
        ((0.0, 0.002, 0.0), [False, False, False]),
    ],
)
def test_clocks_stay_late_only_where_nothing_else_explains_it(monkeypatch, late, stay):
    assert stays(monkeypatch, late) == stay


def test_commands_are_read_exactly_at_the_clocks_in_seconds():
    offsets = np.full((5, 3), 2.0)  # of 10 ms each, as a `Point` has them
    criterion = criterion_of(Stage("polish", 100), {}, offsets)
    np.testing.assert_allclose(criterion.reference_offset, np.full((len(CLOCKS), 3), 0.02))


# a search whose segments' starts are free: the losses it compares are those of its points

OF_SPIN = ("inertia_zz", "moment_constant", "rotor_drag_coefficient")
YAW = ROWS["rate_integral"].stop - 1
OFF = 3.0
"""Standard deviations by which the spin's integrator was off as the flight began."""


def begun_elsewhere():
    """Return a spin whose yaw integrator began far from where it is taken to begin, both free.

    So far that what it does to the flight is no line.
    """
    fit = problem(OF_SPIN)
    start_sd = start_sd_of_spin(np.array([0.0, 2.0]), PHYSICS, np.array([1e-4, 1e-4]))
    start_sd = {row: 10.0 * sd for row, sd in start_sd.items()}
    start = fit.segments.start
    turned = start.rate_integral.z + OFF * start_sd[YAW]
    there = replace(start, rate_integral=replace(start.rate_integral, z=turned))
    flown = with_data(replace(fit, segments=replace(fit.segments, start=there)), truth(fit))
    return replace(
        fit,
        segments=replace(
            fit.segments,
            measured=flown.segments.measured,
            start_sd=jnp.asarray(np.stack([*start_sd.values()])),
            free_rows=(*start_sd,),
        ),
    )


@pytest.mark.parametrize("away", [0.05, 0.4])
def test_a_search_ends_where_its_loss_is_least_from_the_start_that_it_found(away):
    fit = begun_elsewhere()
    rate = float(fit.schedule.log_rate)
    *_, last = plan("gradient", fit.samples, rate, windows=False, robust=False, steps=60)
    true = np.asarray(truth(fit).coefficients)
    progress = run_stages(
        fit,
        (last,),
        initial_progress(fit, true[None] + away),
        free=Point(np.ones(len(OF_SPIN), bool), np.zeros((len(OFFSETS), 2), bool)),
        undecided={},
        on_progress=lambda _: None,
    )
    found = Point(progress.points.coefficients[0], progress.points.offsets[0])
    criterion = criterion_of(last, progress.scales, np.asarray(found.offsets), progress.states)
    sums = fit.sums(found, criterion, derivatives=False)
    compared = sum(float(np.sum(n)) for n in sums.counts.values())
    assert progress.states[-1] == pytest.approx([0.0, OFF], abs=0.01)
    assert progress.losses[0] * compared == pytest.approx(0.5 * OFF**2, rel=0.01)  # its prior's
    assert float(jnp.sum(sums.loss)) == pytest.approx(0.5 * OFF**2, rel=0.01)
    assert np.asarray(found.coefficients) == pytest.approx(true, abs=1e-3)


def test_an_initial_state_is_limited_and_kept_where_it_has_no_estimate():
    fit = begun_elsewhere()
    criterion = replace(
        criterion_of(
            plan("gradient", fit.samples, 200.0, windows=False, robust=False, steps=1)[-1],
            {name: np.ones(2) for name in fit.segments.measured},
            np.zeros((len(OFFSETS), 2)),
        ),
        states=np.zeros((3, 2)),
    )
    sums = fit.sums(truth(fit), criterion, derivatives=False)
    before = np.array([[0.5, 0.0], [0.0, 0.0], [0.0, 0.0]])
    asked = replace(sums, states=np.array([[[np.nan, 1e9], [1.0, -2.0], [0.0, 0.0]]]))
    expected = [[0.5, MAX_STATE_SD], [1.0, -2.0], [0.0, 0.0]]
    np.testing.assert_array_equal(estimated_states(asked, 0, before), expected)
    assert estimated_states(asked, 0, None) is None
    assert need_relinearising(before, np.zeros((3, 2)))
    assert not need_relinearising(before, before + 0.1)
    assert not need_relinearising(None, None)

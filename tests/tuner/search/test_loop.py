"""What is undecided of the loop is decided by the recordings."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from tests.tuner.uncertainty.making import NOISE, problem, with_data
from tuner.objective.criterion import Point
from tuner.objective.segments import OFFSETS
from tuner.search.continuation import run_stages
from tuner.search.progress import Loop, initial_progress, loop_of, with_loop
from tuner.search.stages import schedule_of

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
        schedule_of(fit.samples, fit.schedule.log_rate, robust=True, steps=10),
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


def test_who_sees_the_markers_is_tried_from_where_the_search_began():
    """By another choice the first seconds lead the markers to where none of them flies."""
    fit = problem(tuple(FRAME))
    stages = schedule_of(fit.samples, fit.schedule.log_rate, robust=True, steps=2)
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
    stages = schedule_of(fit.samples, fit.schedule.log_rate, robust=True, steps=4)
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

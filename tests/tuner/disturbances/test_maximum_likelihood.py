"""A descent to least innovations takes steps that are numbers; when another is surely better."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from tests.tuner.uncertainty.making import problem
from tuner.disturbances import maximum_likelihood
from tuner.disturbances.disturbances import (
    INITIAL_STRENGTHS,
    MAX_STRENGTHS,
    MIN_STRENGTHS,
    STRENGTHS,
)
from tuner.disturbances.extended_kalman_filter import FilterResult
from tuner.disturbances.maximum_likelihood import (
    LEAST_CHANGE,
    MAX_STRENGTH_RATIO,
    NEAR_GAIN,
    _Equations,
    _held,
    _strengths_step,
    maximise_likelihood,
)
from tuner.disturbances.observer import FilterInput
from tuner.disturbances.predictor import Predictor
from tuner.objective.criterion import Point
from tuner.objective.normal_equations import Objective
from tuner.search.progress import plain_criterion


def test_no_step_is_taken_where_a_filter_has_lost_a_flight():
    fit = problem(("inertia_xx", "motor_constant"))
    point, count = fit.start(fit.space.initial), 20
    slope, free = np.full(count, -3.0), np.ones(count, bool)
    step = _Equations(slope, np.eye(count), free).step(fit.space, point)
    np.testing.assert_allclose(step[2:], 3.0)
    assert _Equations(slope * np.nan, np.eye(count), free).step(fit.space, point) is None
    bend = np.where(np.eye(count) > 0.0, np.nan, 0.0)
    assert _Equations(slope, bend, free).step(fit.space, point) is None


def test_a_step_is_as_long_as_its_largest_move_but_of_strengths_in_standard_errors():
    moves = np.append(np.zeros(3), np.ones(len(STRENGTHS)))
    hessian = np.diag(np.append([4.0, 1.0, 1.0], np.full(len(STRENGTHS), 100.0)))
    hessian[0, 1] = hessian[1, 0] = 1.2  # together they are known less well: 0.8 and 0.64 of it
    equations = _Equations(moves, hessian, moves > 0.0)
    assert equations.shift(moves) == 0.0
    moves[:2] = 0.5, -0.1
    assert equations.shift(moves) == pytest.approx(0.5 * 2.0 * 0.8)


def test_a_strength_falls_to_none_at_most_and_others_move_as_that_asks() -> None:
    fit = problem(("inertia_xx", "motor_constant"))
    point = fit.start(fit.space.initial)
    count = point.coefficients.size + point.offsets.size + len(STRENGTHS)
    hessian, gradient = np.diag(np.full(count, 4.0)), np.zeros(count)
    lift, lasts = (count - len(STRENGTHS) + STRENGTHS.index(n) for n in ("lift", "gust_lasts"))
    gradient[[lift, lasts]] = 8.0, 1.0
    hessian[lift, lasts] = hessian[lasts, lift] = 1.0
    equations = _Equations(gradient, hessian, np.ones(count, bool))
    step = equations.step(fit.space, point)
    moved = np.flatnonzero(step)
    assert moved.tolist() == [lift, lasts]
    assert step[lift] == LEAST_CHANGE
    assert step[lasts] == pytest.approx(-(1.0 + LEAST_CHANGE) / 4.0)  # not by -2 of the other
    along = _strengths_step(step[-len(STRENGTHS) :])
    assert along[STRENGTHS.index("lift")] == pytest.approx(-np.log(MAX_STRENGTH_RATIO))
    assert along[STRENGTHS.index("gust_lasts")] == step[lasts]
    loss = [equations.gradient @ s + 0.5 * s @ hessian @ s for s in (step, 0.0 * step)]
    assert equations.gain(step) == pytest.approx(loss[1] - loss[0])


@pytest.mark.parametrize("ratio", [0.3, 0.8, 3.0])
def test_a_variance_that_stands_alone_is_found_in_one_step(ratio: float) -> None:
    """Half the log-variance has slope n (1 - ratio²) and information 2 n, for n samples."""
    change = np.full(len(STRENGTHS), -(1.0 - ratio**2) / 2.0)
    found = _strengths_step(change)[STRENGTHS.index("wind")]
    assert found == pytest.approx(np.log(ratio))


def test_a_strength_near_none_stays_until_its_slope_points_up() -> None:
    inside, flat = 0.5 * (MIN_STRENGTHS + MAX_STRENGTHS), 0.5 * np.eye(len(STRENGTHS))
    times = np.array(["lasts" in name for name in STRENGTHS])
    np.testing.assert_array_equal(_held(inside, np.full(8, 0.19), flat), ~times)
    for slope, information in ((-0.01, flat), (0.21, flat), (0.19, 4.0 * flat)):
        assert not _held(inside, np.full(8, slope), information).any()
    for bound, outside in ((MIN_STRENGTHS, 1.0), (MAX_STRENGTHS, -1.0)):
        assert _held(bound, np.full(8, outside), flat).all()
        assert not _held(bound, np.full(8, -outside), flat).any()


class LikeliestAtStart(Predictor):
    """A predictor by which recordings are less likely at each point but the first."""

    def at(self, objective: Objective, point: Point) -> Predictor:
        rows, far = np.zeros((1, 0, 2)), bool((point.coefficients != objective.space.initial).any())
        return replace(self, found=FilterResult(rows, rows, np.full((1, 2), far, float), None))


@pytest.mark.parametrize(("gain", "taken"), [(0.9 * NEAR_GAIN, True), (1.1 * NEAR_GAIN, False)])
def test_a_step_near_the_estimate_is_taken_though_recordings_are_less_likely_after_it(
    monkeypatch: pytest.MonkeyPatch, gain: float, taken: bool
) -> None:
    fit = problem(("inertia_xx", "motor_constant"))
    point, criterion = fit.start(fit.space.initial), plain_criterion(fit, fit.samples)
    moves = np.zeros(point.coefficients.size + point.offsets.size + len(STRENGTHS))
    moves[0] = 1e-3
    free, hessian = moves > 0.0, np.diag(np.full(len(moves), 2.0 * gain / moves[0] ** 2))
    equations = _Equations(-hessian @ moves, hessian, free)
    assert equations.gain(moves) == pytest.approx(gain)
    monkeypatch.setattr(maximum_likelihood, "_equations", lambda *_: equations)
    inputs = FilterInput(fit.segments, point.offsets, {})
    predictor = LikeliestAtStart(fit.schedule, inputs, {}, INITIAL_STRENGTHS, {})
    given = (fit, point, criterion)
    _, end = maximise_likelihood(predictor, [], given, free[: -len(STRENGTHS)], steps=1)
    change = end.coefficients - point.coefficients
    np.testing.assert_allclose(fit.space.slope(point.coefficients) * change, taken * moves[:2])


def test_a_filter_flies_on_the_voltage_that_another_problem_reads():
    """What it does then is seen in `test_predictor`, at length."""
    fit = problem(("inertia_xx",))
    inputs = FilterInput(fit.segments, np.zeros((5, fit.segments.count)), {})
    predictor = Predictor(fit.schedule, inputs, {}, INITIAL_STRENGTHS, {})
    volts = np.full((3, fit.segments.count), 0.1)
    other = replace(fit, segments=replace(fit.segments, log_voltage=volts))
    assert predictor.for_problem(fit).inputs.segments.log_voltage is None
    assert predictor.for_problem(other).inputs.segments.log_voltage is volts


@pytest.mark.parametrize(("gain", "likelier"), [(5.0, True), (4.0, False), (-5.0, False)])
def test_recordings_are_likelier_by_a_gain_of_three_standard_errors(gain, likelier):
    before = np.random.default_rng(0).normal(size=(1800, 3))
    after = before - gain / before.size
    one, other = (
        cast(Any, SimpleNamespace(found=SimpleNamespace(loss=loss))) for loss in (after, before)
    )
    assert Predictor.is_likelier_than(one, other) == likelier

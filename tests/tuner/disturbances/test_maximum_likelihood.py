"""A descent to least innovations takes steps that are numbers; when another is surely better."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from tests.tuner.uncertainty.making import problem
from tuner.disturbances.disturbances import INITIAL_STRENGTHS
from tuner.disturbances.maximum_likelihood import _Equations
from tuner.disturbances.observer import FilterInput
from tuner.disturbances.predictor import Predictor


def test_no_step_is_taken_where_a_filter_has_lost_a_flight():
    fit = problem(("inertia_xx", "motor_constant"))
    point, count = fit.start(fit.space.initial), 20
    slope, free = np.full(count, -3.0), np.ones(count, bool)
    step = _Equations(slope, np.eye(count), free).step(fit.space, point)
    np.testing.assert_allclose(step[2:], 3.0)
    assert _Equations(slope * np.nan, np.eye(count), free).step(fit.space, point) is None
    bend = np.where(np.eye(count) > 0.0, np.nan, 0.0)
    assert _Equations(slope, bend, free).step(fit.space, point) is None


def test_a_filter_flies_on_the_voltage_that_another_problem_reads():
    """What it does then is seen in `test_predictor`, at length."""
    fit = problem(("inertia_xx",))
    inputs = FilterInput(fit.segments, np.zeros((5, fit.segments.count)), {})
    predictor = Predictor(fit.schedule, inputs, {}, INITIAL_STRENGTHS, {})
    volts = np.full((3, fit.segments.count), 0.1)
    other = replace(fit, segments=replace(fit.segments, log_voltage=volts))
    assert predictor.for_problem(fit).inputs.segments.log_voltage is None
    assert predictor.for_problem(other).inputs.segments.log_voltage is volts


@pytest.mark.parametrize(
    ("gain", "only_in", "likelier"),
    [
        (0.5, slice(None), True),
        (-0.5, slice(None), False),
        (0.0, slice(None), False),
        (50.0, slice(200), False),
    ],
    ids=["everywhere", "less likely", "chance", "in one manoeuvre"],
)
def test_recordings_are_surely_likelier_if_most_of_them_are(gain, only_in, likelier):
    rng = np.random.default_rng(0)
    before = rng.normal(size=(1800, 3))
    after = before + rng.normal(size=before.shape)
    after[only_in, 0] -= gain
    after[only_in, 1:] -= gain * (only_in == slice(None))
    one, other = (
        cast(
            Any,
            SimpleNamespace(
                schedule=SimpleNamespace(log_rate=100), found=SimpleNamespace(loss=loss)
            ),
        )
        for loss in (after, before)
    )
    assert Predictor.is_likelier_than(one, other) == likelier

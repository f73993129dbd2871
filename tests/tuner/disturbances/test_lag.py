"""A second lag of the motors makes gusty flights surely likelier, if there is one."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.tuner.disturbances.test_predictor import OFFSETS, gusty
from tests.tuner.uncertainty import making
from tuner.config import JobFile
from tuner.disturbances.maximum_likelihood import maximise_likelihood
from tuner.disturbances.predictor import Predictor
from tuner.objective.information import with_start_values
from tuner.objective.normal_equations import Objective
from tuner.objective.space import extended
from tuner.recordings.flight import Flight
from tuner.vehicle.model import with_coefficients

pytestmark = [pytest.mark.slow, pytest.mark.long]

FREE = ("time_constant_up", "time_constant_down", "actuator_latency")
LAG = "time_constant_second"


def descended(
    problem: Objective, flights: list[Flight], vector: np.ndarray
) -> tuple[Predictor, dict[str, jax.Array]]:
    """Return what predicts best from a vector on, and its numbers."""
    point = problem.start(vector)
    predictor = Predictor.of(problem, point, flights, (LAG,))
    assert predictor is not None
    criterion = making.fitted_of(problem, point).criterion
    moves = np.concatenate([np.ones(len(vector), bool), OFFSETS.ravel()])
    predictor, point = maximise_likelihood(predictor, flights, (problem, point, criterion), moves)
    return predictor, problem.space.numbers(point.coefficients)


@pytest.mark.parametrize("second", [0.006, 0.0])
def test_samples_call_for_a_second_lag_that_is_there(second: float) -> None:
    exact = making.problem(FREE)
    there = with_coefficients(exact.model, {LAG: jnp.asarray(second)})
    problem, flights = gusty(replace(exact, model=there), 1)
    problem = replace(problem, model=with_coefficients(exact.model, {LAG: jnp.asarray(0.0)}))
    without, _ = descended(problem, flights, problem.space.initial)
    wide = replace(problem, space=extended(problem.space, (LAG,), JobFile(), {LAG: 0.0}))
    beside, numbers = descended(
        wide, flights, with_start_values(wide.space, wide.space.initial, (LAG,))
    )
    assert beside.is_likelier_than(without) == (second > 0.0)
    if second:
        assert float(numbers[LAG]) == pytest.approx(second, abs=0.002)

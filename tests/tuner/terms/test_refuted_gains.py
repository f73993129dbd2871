"""Gains that simulated flights want, and recorded commands do not have."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest

from tests.tuner.uncertainty import making
from tests.tuner.uncertainty.test_model_error import flown, problem
from tuner.config import JobFile
from tuner.objective.criterion import Point
from tuner.terms.candidates import SelectionResult, with_terms
from tuner.terms.selection import GAIN_AXES, refuted_by_commands, with_refuted
from tuner.vehicle.selection_table import SelectionCode, SelectionRow

ROW = SelectionRow(
    group="rate_gain", names=tuple(GAIN_AXES), kept=True, reason=SelectionCode.SIGNIFICANT
)


@pytest.mark.parametrize(
    ("flies", "found", "refuted"),
    [(1.0, 0.9, ("rate_gain",)), (1.06, 1.06, ()), (1.06, 1.15, ())],
    ids=["the file's", "those that were found", "neither"],
)
def test_commands_take_back_gains_that_are_the_files(flies, found, refuted):
    objective = problem(dict.fromkeys(GAIN_AXES, 1.0))
    _, flights = flown(problem(dict.fromkeys(GAIN_AXES, flies)), 0, loop=True)
    objective, point = with_terms(objective, making.truth(objective), tuple(GAIN_AXES), JobFile())
    numbers = objective.space.numbers(point.coefficients) | dict.fromkeys(GAIN_AXES, found)
    point = Point(objective.space.vector_of(numbers), point.offsets)
    fitted = making.fitted_of(objective, point)
    job = cast(Any, SimpleNamespace(fitted=tuple(flights)))
    selected = SelectionResult(job, fitted, (ROW,))
    assert refuted_by_commands(selected) == refuted
    assert with_refuted(selected, refuted).kept == (() if refuted else ("rate_gain",))

"""Profiles of the likelihood against the intervals of the quadratic approximation."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests.tuner.uncertainty import making
from tuner.core.errors import InputError
from tuner.job.sensitivity import _uncertainty_with
from tuner.objective.normal_equations import Objective
from tuner.search.progress import Fit
from tuner.uncertainty.estimates import Uncertainty, uncertainty_of
from tuner.uncertainty.examination import FullProblem, full_problem_of
from tuner.uncertainty.identifiability import profile_likelihood
from tuner.uncertainty.records import Profile, Profiles

FREE = (
    "inertia_xx",
    "input_scaling",
    "motor_constant",
    "moment_constant",
    "rolling_moment_coefficient",
)


@pytest.fixture(scope="module")
def objective() -> Objective:
    return making.problem(FREE, seed=0)


@pytest.fixture(scope="module")
def fitted(objective: Objective) -> Fit:
    return making.fitted_of(objective, making.truth(objective))


@pytest.fixture(scope="module")
def full_problem(fitted: Fit) -> FullProblem:
    return full_problem_of(fitted.objective, fitted.point)


@pytest.fixture(scope="module")
def uncertainty(fitted: Fit) -> Uncertainty:
    return uncertainty_of(fitted)


@pytest.fixture(scope="module")
def known(full_problem: FullProblem, uncertainty: Uncertainty, fitted: Fit) -> Profile:
    return profile_likelihood(full_problem, uncertainty, fitted.criterion, "moment_constant")


@pytest.mark.slow
def test_a_well_known_coefficients_profile_is_its_interval(
    uncertainty: Uncertainty, known: Profile
) -> None:
    low, high = uncertainty.estimates["moment_constant"].ci95
    assert known.interval[0] is not None
    assert known.interval[1] is not None
    assert known.interval[1] - known.interval[0] == pytest.approx(high - low, rel=0.1)
    assert min(value for value in known.rise if value is not None) == 0.0


@pytest.mark.slow
def test_an_unidentifiable_coefficient_has_an_open_profile(
    full_problem: FullProblem,
    uncertainty: Uncertainty,
    fitted: Fit,
    known: Profile,
    tmp_path: Path,
) -> None:
    rough = {name: 30.0 * scale for name, scale in fitted.criterion.scale.items()}
    criterion = replace(fitted.criterion, scale=rough)
    rolling = profile_likelihood(full_problem, uncertainty, criterion, "rolling_moment_coefficient")
    assert rolling.interval == (None, None)
    Profiles(profiles=[known, rolling]).write(tmp_path)
    read = Profiles.read_if_any(tmp_path)
    assert read is not None
    assert read.profiles == [known, rolling]


def test_an_unknown_coefficient_is_named(uncertainty: Uncertainty) -> None:
    sensitivity = SimpleNamespace(steps=dict.fromkeys(uncertainty.names, 1.0))
    examined: Any = SimpleNamespace(uncertainty=uncertainty, of_fixed={}, sensitivity=sensitivity)
    with pytest.raises(InputError, match="did you mean 'moment_constant'"):
        _uncertainty_with(examined, "moment_constand")

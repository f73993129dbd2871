"""Profiles of the likelihood against the intervals of the quadratic approximation."""

from __future__ import annotations

from pathlib import Path

import equinox as eqx
import numpy as np
import pytest

from tests.tuner.uncertainty import making
from tuner.errors import InputError
from tuner.examination.examination import Examination, examine
from tuner.job.sensitivity import _uncertainty_with
from tuner.objective.normal import Objective
from tuner.search.fitted import Fitted
from tuner.uncertainty.profile_likelihood import profile_likelihood
from tuner.uncertainty.profiles_json import Profile, Profiles

FREE = (
    "inertia_xx",
    "input_scaling",
    "motor_constant",
    "moment_constant",
    "rolling_moment_coefficient",
)


@pytest.fixture(scope="module")
def objective() -> Objective:
    exact = making.problem(FREE)
    return making.with_data(exact, making.truth(exact), noise=np.random.default_rng(0))


@pytest.fixture(scope="module")
def fitted(objective: Objective) -> Fitted:
    return making.fitted_of(objective, making.truth(objective))


@pytest.fixture(scope="module")
def examination(fitted: Fitted) -> Examination:
    return examine(fitted)


@pytest.fixture(scope="module")
def known(examination: Examination, fitted: Fitted) -> Profile:
    return profile_likelihood(
        examination.full_problem, examination.uncertainty, fitted.criterion, "moment_constant"
    )


@pytest.mark.slow
def test_a_well_known_coefficients_profile_is_its_interval(
    examination: Examination, known: Profile
) -> None:
    low, high = examination.uncertainty.estimates["moment_constant"].ci95
    assert known.interval[0] is not None
    assert known.interval[1] is not None
    assert known.interval[1] - known.interval[0] == pytest.approx(high - low, rel=0.1)
    assert min(value for value in known.rise if value is not None) == 0.0


@pytest.mark.slow
def test_what_is_not_identifiable_has_an_open_profile(
    examination: Examination, fitted: Fitted, known: Profile, tmp_path: Path
) -> None:
    rough = {name: 30.0 * scale for name, scale in fitted.criterion.scale.items()}
    criterion = eqx.tree_at(lambda s: s.scale, fitted.criterion, rough)
    rolling = profile_likelihood(
        examination.full_problem, examination.uncertainty, criterion, "rolling_moment_coefficient"
    )
    assert rolling.interval == (None, None)
    Profiles(profiles=[known, rolling]).write(tmp_path)
    read = Profiles.read_if_any(tmp_path)
    assert read is not None
    assert read.profiles == [known, rolling]


@pytest.mark.slow
def test_an_unknown_coefficient_is_named(examination: Examination) -> None:
    with pytest.raises(InputError, match="did you mean 'moment_constant'"):
        _uncertainty_with(examination, "moment_constand")

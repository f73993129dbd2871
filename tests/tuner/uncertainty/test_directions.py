"""The combinations of coefficients that are determined worst."""

from __future__ import annotations

import numpy as np
import pytest

from tuner.uncertainty.estimates import is_common_scale, worst_directions

NAMES = ("mass", "inertia_xx", "motor_constant", "input_scaling")


def covariance_of(vector: list[float], error: float) -> np.ndarray:
    unit = np.array(vector) / np.linalg.norm(vector)
    return 1e-6 * np.eye(len(unit)) + error**2 * np.outer(unit, unit)


def test_a_common_scale_is_named_as_such() -> None:
    worst = worst_directions(covariance_of([1, 1, 1, 0], 30.0), np.ones(4), NAMES)[0]
    assert worst.null
    assert worst.common_scale
    assert set(worst.moves) == {"mass", "inertia_xx", "motor_constant"}


def test_a_trade_off_is_named_with_its_proportion_and_size() -> None:
    worst = worst_directions(covariance_of([0, 0, 1, -0.5], 0.1), np.ones(4), NAMES)[0]
    assert not worst.null
    assert worst.moves == pytest.approx({"motor_constant": 1.0, "input_scaling": -0.5})
    # one standard error along the eigenvector moves its largest member by 0.1·1/√1.25
    assert worst.error == pytest.approx(0.1 / np.sqrt(1.25), rel=1e-3)


def test_one_coefficient_alone() -> None:
    worst = worst_directions(covariance_of([0, 1, 0, 0], 0.2), np.ones(4), NAMES)[0]
    assert worst.moves == {"inertia_xx": 1.0}
    assert worst.error == pytest.approx(0.2, rel=1e-3)


def test_the_reference_is_the_change_of_a_hundred_percent() -> None:
    covariance = np.diag([1e-4, 1e-4, 1e-4, 4e-6])
    reference = np.array([1.0, 1.0, 1.0, 0.01])
    worst = worst_directions(covariance, reference, NAMES)[0]
    assert set(worst.moves) == {"input_scaling"}
    assert worst.error == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("moves", "common"),
    [
        ({"mass": 1.0, "motor_constant": 0.97, "moment_constant": 0.01}, True),
        ({"mass": 1.0, "motor_constant": 0.5}, False),
        ({"mass": 1.0, "motor_constant": 1.0, "moment_constant": 0.6}, False),
        ({"motor_constant": 1.0, "inertia_xx": 1.0}, False),
    ],
)
def test_directions_of_a_common_scale(moves: dict[str, float], common: bool) -> None:
    assert is_common_scale(moves) is common

"""Markers beside the centre of mass and off its axes: compared so, and estimated."""

import jax.numpy as jnp
import numpy as np
import pytest

from tests.tuner.uncertainty.making import (
    criterion_of,
    fly_at,
    problem,
    with_data,
)
from tuner.objective.criterion import Point
from tuner.objective.normal_equations import normal_equations
from tuner.search.progress import Loop, with_loop
from tuner.vehicle import COEFFICIENTS
from tuner.vehicle.coefficient import NoExportTag

TRUTH = {
    "marker_offset_x": 0.012,
    "marker_offset_y": -0.008,
    "marker_offset_z": 0.035,
    "marker_tilt_x": 0.0105,
    "marker_tilt_y": -0.0157,
    "marker_tilt_z": 0.0262,
}


@pytest.fixture(scope="module")
def fit():
    """Return a fit of the markers alone, and the point that made its data."""
    objective = problem(tuple(TRUTH))
    point = Point(
        jnp.asarray(objective.space.vector_of(TRUTH)),
        objective.start(objective.space.initial).offsets,
    )
    return with_data(objective, point), point


def equations(objective, vector):
    point, criterion = objective.start(vector), criterion_of(objective, prior=0.0)
    sums = objective.sums(point, criterion)
    return normal_equations(objective, point, criterion, sums)


def test_the_markers_are_flown_around_the_centre_of_mass(fit):
    objective, point = fit
    seen, plain = (
        fly_at(objective, point),
        fly_at(objective, objective.start(objective.space.initial)),
    )
    offset = seen["position"][0] - plain["position"][0]
    np.testing.assert_allclose(offset, 0.0, atol=1e-12)  # both starts were recorded there
    np.testing.assert_array_equal(seen["rotor_speed"][0], plain["rotor_speed"][0])


@pytest.mark.parametrize("sees_markers", [0.0, 1.0])
def test_the_gradient_is_the_finite_difference(fit, sees_markers):
    objective = with_loop(fit[0], Loop(sees_markers=sees_markers))
    vector = np.asarray(objective.space.vector_of({name: 0.5 * v for name, v in TRUTH.items()}))
    _, gradient, _ = equations(objective, vector)
    for index in range(len(vector)):
        step = 1e-4 * np.eye(len(vector))[index]
        difference = (
            equations(objective, vector + step)[0] - equations(objective, vector - step)[0]
        ) / 2e-4
        assert float(gradient[index]) == pytest.approx(float(difference), rel=1e-4, abs=1e-7)


def test_a_loop_that_sees_the_markers_flies_otherwise(fit):
    objective, point = fit
    seen = fly_at(with_loop(objective, Loop(sees_markers=1.0)), point)
    plain = fly_at(objective, point)
    # a hover whose attitude controller sees 16 mrad too little keeps away by g·tilt over its gain
    away = np.max(np.abs(seen["position"] - plain["position"]), axis=0)
    assert (away[:2, 0] > 5e-3).all()


def test_offset_and_tilt_are_estimated(fit):
    objective, _ = fit
    vector = np.asarray(objective.space.initial)
    for _ in range(5):
        _, gradient, hessian = equations(objective, vector)
        count = len(vector)
        vector = vector - np.linalg.solve(hessian[:count, :count], gradient[:count])
    values = objective.space.numbers(vector)
    for name, value in TRUTH.items():
        assert float(values[name]) == pytest.approx(value, abs=1e-6)


def test_no_target_carries_markers():
    for name in TRUTH:
        assert all(
            isinstance(place, NoExportTag) for place in COEFFICIENTS[name].exported_as.values()
        )

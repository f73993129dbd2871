"""Markers beside the centre of mass and off its axes: recorded so, mapped back, and estimated."""

import jax.numpy as jnp
import numpy as np
import pytest

from sim_jax.rigid_body import Motion
from sim_jax.rotation import Quaternion
from sim_jax.state import Start
from sim_jax.vector import Vec3
from tests.sim_jax.derivatives import assert_derivatives
from tests.tuner.uncertainty.making import (
    controller_file,
    criterion_of,
    fly_at,
    problem,
    vehicle_file,
    with_data,
)
from tuner.coefficients import COEFFICIENTS
from tuner.coefficients.coefficient import NotCarried
from tuner.model import model_of
from tuner.objective.criterion import Point
from tuner.objective.markers import Markers, markers_of, rotation
from tuner.search.normal_equations import normal_equations

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
    return normal_equations(objective.space, objective.segments.flight, point, criterion, sums)


@pytest.mark.parametrize("vector", [(0.0, 0.0, 0.0), (0.1, -0.2, 0.3)])
def test_the_rotation_by_a_vector_has_its_derivatives_at_zero_too(vector):
    assert_derivatives(lambda v: rotation(Vec3.of(v)), jnp.asarray(vector))


def test_the_rotation_turns_by_the_length_of_its_vector():
    turn = rotation(Vec3.of(jnp.asarray([0.0, 0.0, 0.3])))
    np.testing.assert_allclose(turn.roll_pitch_yaw().stacked(), [0.0, 0.0, 0.3], atol=1e-14)
    assert float(jnp.sum(turn.stacked() ** 2)) == pytest.approx(1.0, abs=1e-14)
    barely = rotation(Vec3.of(jnp.asarray([1.99e-3, 0.0, 0.0])))
    assert float(barely.x) == pytest.approx(np.sin(0.995e-3), rel=1e-12)


def motion():
    numbers = jnp.asarray([1.0, 2.0, 3.0])
    attitude = Quaternion.of(jnp.asarray([0.9, 0.1, -0.2, 0.4])).normalized()
    return Motion(Vec3.of(numbers), Vec3.of(numbers), attitude, Vec3.of(numbers))


def test_a_start_is_where_the_markers_say():
    markers = Markers(
        Vec3.of(jnp.asarray([0.01, 0.02, 0.03])), rotation(Vec3.of(jnp.ones(3) * 0.02))
    )
    position, attitude = markers.recorded(motion())
    seen = Start(
        Motion(position, motion().velocity, attitude, motion().body_rate),
        (jnp.zeros(()),) * 4,
        (jnp.zeros(()),) * 4,
        Vec3.of(jnp.zeros(3)),
    )
    start = markers.start(seen, None).motion
    np.testing.assert_allclose(start.position.stacked(), motion().position.stacked(), atol=1e-14)
    np.testing.assert_allclose(start.attitude.stacked(), motion().attitude.stacked(), atol=1e-14)
    rests = markers.start(seen, jnp.asarray(True)).motion.attitude
    assert float(rests.z_axis().z) == 1.0


def test_markers_at_the_centre_of_mass_are_none():
    file = vehicle_file().replace(effects=dict.fromkeys(TRUTH, 0.0))
    assert markers_of(model_of(file, controller_file()).vehicle) is None
    one = vehicle_file().replace(effects={"marker_offset_x": 0.01})
    markers = markers_of(model_of(one, controller_file()).vehicle)
    assert markers is not None
    assert markers.turn is None


def test_the_markers_are_flown_around_the_centre_of_mass(fit):
    objective, point = fit
    seen, plain = (
        fly_at(objective, point),
        fly_at(objective, objective.start(objective.space.initial)),
    )
    offset = seen["position"][0] - plain["position"][0]
    np.testing.assert_allclose(offset, 0.0, atol=1e-12)  # both starts were recorded there
    np.testing.assert_array_equal(seen["rotor_speed"][0], plain["rotor_speed"][0])


def test_the_gradient_is_the_finite_difference(fit):
    objective, _ = fit
    vector = np.asarray(objective.space.vector_of({name: 0.5 * v for name, v in TRUTH.items()}))
    _, gradient, _ = equations(objective, vector)
    for index in range(len(vector)):
        step = 1e-4 * np.eye(len(vector))[index]
        difference = (
            equations(objective, vector + step)[0] - equations(objective, vector - step)[0]
        ) / 2e-4
        assert float(gradient[index]) == pytest.approx(float(difference), rel=1e-4, abs=1e-7)


def test_offset_and_tilt_are_estimated(fit):
    objective, _ = fit
    vector = np.asarray(objective.space.initial)
    for _ in range(5):
        _, gradient, hessian = equations(objective, vector)
        count = len(vector)
        vector = vector - np.linalg.solve(hessian[:count, :count], gradient[:count])
    values = objective.space.values(jnp.asarray(vector))
    for name, value in TRUTH.items():
        assert float(values[name]) == pytest.approx(value, abs=1e-6)


def test_no_target_carries_markers():
    for name in TRUTH:
        assert all(
            isinstance(place, NotCarried) for place in COEFFICIENTS[name].exported_as.values()
        )

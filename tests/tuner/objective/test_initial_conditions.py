"""Free starts: eliminated as linear algebra says, and moved as their names say."""

import jax.numpy as jnp
import numpy as np
import pytest

from sim_jax.state import hover
from sim_jax.vector import Vec3
from tests.tuner.uncertainty.making import controller_file, vehicle_file
from tuner.model import model_of
from tuner.objective.initial_conditions import (
    eliminated,
    freedom_of,
    moved,
    spun_up,
    whole,
)

COUNT = len(freedom_of(()))


def test_elimination_is_the_minimum_over_the_start():
    rng = np.random.default_rng(0)
    kept, states, segments = 3, 4, 5
    root = rng.normal(size=(segments, kept + states, 12))
    hessian = np.einsum("fpn,fqn->pqf", root, root)
    gradient = rng.normal(size=(kept + states, segments))
    centre = rng.normal(size=(states, segments))
    loss = 50.0 + rng.random(segments)
    least, left, information, best = eliminated(
        jnp.asarray(loss), jnp.asarray(gradient), jnp.asarray(hessian), jnp.asarray(centre)
    )
    for segment in range(segments):
        curvature = hessian[kept:, kept:, segment] + np.eye(states)
        pull = gradient[kept:, segment] + centre[:, segment]
        step = -np.linalg.solve(curvature, pull)
        np.testing.assert_allclose(best[:, segment], centre[:, segment] + step, rtol=1e-9)
        want = loss[segment] + 0.5 * centre[:, segment] @ centre[:, segment] + 0.5 * pull @ step
        assert float(least[segment]) == pytest.approx(want)
        across = hessian[:kept, kept:, segment]
        np.testing.assert_allclose(left[:, segment], gradient[:kept, segment] + across @ step)
        np.testing.assert_allclose(
            information[..., segment],
            hessian[:kept, :kept, segment] - across @ np.linalg.solve(curvature, across.T),
            rtol=1e-9,
        )


@pytest.fixture(scope="module")
def still():
    model = model_of(vehicle_file(), controller_file())
    return model.vehicle, hover(model.vehicle, Vec3(*jnp.ones((3, 2))))


def test_a_start_moves_by_what_it_is_told(still):
    _, start = still
    change = np.zeros((COUNT, 2))
    change[0], change[3 + 1], change[6 + 2], change[12 + 3, 1] = 0.1, 0.2, 0.02, 0.5
    there = moved(start, jnp.asarray(change))
    assert np.asarray(there.motion.position.x) == pytest.approx(1.1)
    assert np.asarray(there.motion.velocity.y) == pytest.approx(0.2)
    assert np.asarray(there.motion.attitude.roll_pitch_yaw().z) == pytest.approx(0.02, rel=1e-3)
    assert np.asarray(there.rotor_speed[3] / start.rotor_speed[3]) == pytest.approx([1.0, 1.5])


def test_what_cannot_matter_is_not_free():
    free = freedom_of(("rotor_speed",))
    assert np.count_nonzero(free) == COUNT - 4


def test_what_is_free_of_a_start_takes_its_place_in_all_of_it():
    change = jnp.asarray([[1.0, 2.0], [3.0, 4.0]])
    all_of_it = np.asarray(whole(change, (1, COUNT - 1)))
    assert all_of_it.shape == (COUNT, 2)
    np.testing.assert_array_equal(all_of_it[[1, COUNT - 1]], change)
    assert np.count_nonzero(all_of_it) == 4


def test_a_rotor_without_tachometer_turns_as_its_command_asks(still):
    vehicle, start = still
    turning = jnp.asarray([[np.nan, 0.3]] + [[np.nan, np.nan]] * 3)
    there = spun_up(start, vehicle, turning)
    motor = vehicle.motor
    asked = 0.3 * float(motor.input_scaling) + float(motor.zero_position_armed)
    assert float(there.rotor_speed[0][1]) == pytest.approx(asked)
    for rotor in range(1, 4):
        np.testing.assert_array_equal(there.rotor_speed[rotor][1], start.rotor_speed[rotor])

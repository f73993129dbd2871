"""Markers beside the centre of mass and off its axes: recorded so, mapped back, and seen."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim_jax.constants import GRAVITY
from sim_jax.control.geometric import ReferencePoint
from sim_jax.frames import Markers, markers_of
from sim_jax.geometry import Quaternion, Vec3, rotation
from sim_jax.inlet import ReferenceInlet
from sim_jax.rigid_body import Motion
from sim_jax.state import Start, hover
from tests.sim_jax.derivatives import assert_derivatives
from tests.sim_jax.support import compiled_rollout
from tests.tuner.uncertainty.making import controller_file, vehicle_file
from tuner.vehicle.model import model_of, schedule_of

TILT = {"marker_tilt_x": 0.01, "marker_tilt_y": -0.015}
FRAME = {"marker_offset_x": 0.012, "marker_offset_z": 0.035, "marker_tilt_z": 0.03, **TILT}


@pytest.mark.parametrize("vector", [(0.0, 0.0, 0.0), (0.1, -0.2, 0.3)])
def test_the_rotation_by_a_vector_has_its_derivatives_at_zero_too(vector):
    assert_derivatives(lambda v: rotation(Vec3.of(v)), jnp.asarray(vector))


def test_the_rotation_turns_by_the_length_of_its_vector():
    turn = rotation(Vec3.of(jnp.asarray([0.0, 0.0, 0.3])))
    ahead = turn.heading().stacked()
    np.testing.assert_allclose(ahead, [np.cos(0.3), np.sin(0.3), 0.0], atol=1e-14)
    assert float(jnp.sum(turn.stacked() ** 2)) == pytest.approx(1.0, abs=1e-14)
    barely = rotation(Vec3.of(jnp.asarray([1.99e-3, 0.0, 0.0])))
    assert float(barely.x) == pytest.approx(np.sin(0.995e-3), rel=1e-12)


def motion():
    numbers = jnp.asarray([1.0, 2.0, 3.0])
    attitude = Quaternion.of(jnp.asarray([0.9, 0.1, -0.2, 0.4])).normalized()
    return Motion(Vec3.of(numbers), Vec3.of(numbers), attitude, Vec3.of(numbers))


def test_a_start_is_where_the_markers_say():
    markers = Markers(
        Vec3.of(jnp.asarray([0.03, -0.02, 0.01])), rotation(Vec3.of(jnp.ones(3) * 0.02))
    )
    position, attitude = markers.recorded(motion())
    seen = Start(
        Motion(position, motion().velocity, attitude, motion().body_rate),
        (jnp.zeros(()),) * 4,
        (jnp.zeros(()),) * 4,
        Vec3.of(jnp.zeros(3)),
    )
    start = markers.start(seen, None, jnp.zeros(())).motion
    np.testing.assert_allclose(start.position.stacked(), motion().position.stacked(), atol=1e-14)
    np.testing.assert_allclose(start.attitude.stacked(), motion().attitude.stacked(), atol=1e-14)
    np.testing.assert_array_equal(start.velocity.stacked(), motion().velocity.stacked())
    rests = markers.start(seen, jnp.asarray(True), jnp.zeros(())).motion.attitude
    assert float(rests.z_axis().z) == 1.0


def test_markers_at_the_centre_of_mass_are_none():
    file = vehicle_file().replace(effects=dict.fromkeys(FRAME, 0.0))
    assert not jax.tree.leaves(markers_of(model_of(file, controller_file()).vehicle))
    one = vehicle_file().replace(effects={"marker_offset_x": 0.01})
    markers = markers_of(model_of(one, controller_file()).vehicle)
    assert markers.offset is not None
    assert markers.turn is None


def test_the_velocity_that_is_seen_is_that_of_the_point_that_is_recorded():
    markers = Markers(Vec3.of(jnp.asarray([0.01, -0.02, 0.03])), None)
    step = 1e-6
    at = motion()
    turned = at.attitude.product(rotation(at.body_rate * step))
    later = Motion(at.position + at.velocity * step, at.velocity, turned, at.body_rate)
    moved = (markers.recorded(later)[0] - markers.recorded(at)[0]) * (1.0 / step)
    np.testing.assert_allclose(markers.seen(at).velocity.stacked(), moved.stacked(), rtol=1e-5)
    recorded = markers.seen(at)
    seen = Start(recorded, (jnp.zeros(()),) * 4, (jnp.zeros(()),) * 4, Vec3.of(jnp.zeros(3)))
    start = markers.start(seen, None, jnp.ones(())).motion
    np.testing.assert_allclose(start.velocity.stacked(), at.velocity.stacked(), rtol=1e-14)


def hovered(effects, *, sees_markers):
    """Return the log of eight seconds in which a vehicle is sent to one point."""
    file = controller_file()
    file = file.replace(sensing=file.sensing.replace(sees_markers=sees_markers))
    model = model_of(vehicle_file().replace(effects=effects), file)
    point = Vec3(jnp.zeros(801), jnp.zeros(801), jnp.ones(801))
    still = Vec3.zeros(jnp.zeros(801))
    start = hover(model.vehicle, Vec3.of(jnp.asarray([0.0, 0.0, 1.0])))
    schedule = schedule_of(file, log_rate=100)
    inlet = ReferenceInlet(ReferencePoint(point, still, still))
    return compiled_rollout(
        model.vehicle, model.controller, schedule, inlet, start, samples=800
    ).log


def test_who_sees_a_tilted_frame_hovers_level_and_away_from_where_it_is_sent():
    """Position control asks for the tilt that it sees: g·tilt over its gain from the point."""
    motion = hovered({**dict.fromkeys(FRAME, 0.0), **TILT}, sees_markers=True).motion
    gain = controller_file().position.kp[0]
    lift = GRAVITY + controller_file().position.kp[2] * (1.0 - float(motion.position.z[-1]))
    # the frame leans by tilt_y towards +x and by -tilt_x towards +y, where the thrust is asked for
    assert float(motion.position.x[-1]) == pytest.approx(0.015 * lift / gain, rel=0.01)
    assert float(motion.position.y[-1]) == pytest.approx(0.010 * lift / gain, rel=0.01)
    assert float(motion.attitude.z_axis().z[-1]) == pytest.approx(1.0, abs=1e-9)


def test_markers_that_are_not_seen_or_sit_true_change_nothing_in_the_loop():
    plain = hovered({}, sees_markers=True)
    for log in (hovered(FRAME, sees_markers=False), hovered({}, sees_markers=False)):
        np.testing.assert_array_equal(jnp.stack(log.rotor_speed), jnp.stack(plain.rotor_speed))
        np.testing.assert_array_equal(
            log.motion.position.stacked(), plain.motion.position.stacked()
        )

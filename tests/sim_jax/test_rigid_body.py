"""What a free body keeps, and how fast each integrator converges."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax
import numpy as np
import pytest

from sim_jax.constants import GRAVITY
from sim_jax.geometry import Vec3
from sim_jax.rigid_body import Motion, Wrench, step_midpoint, step_semi_implicit
from sim_jax.vehicle import Body
from tests.golden_check.runge_kutta import step_rk4
from tests.sim_jax.support import apart, quaternion, vec

Step = Callable[..., Motion]
STEPS = [step_semi_implicit, step_midpoint, step_rk4]
BODY = Body(2.0, 0.02, 0.03, 0.045)
TUMBLING = Motion(
    vec(0.0, 0.0, 10.0), vec(1.0, 2.0, 3.0), quaternion(1.0, 0.3, -0.2, 0.5), vec(2.0, -1.0, 4.0)
)


def nothing(motion: Motion) -> Wrench:
    zero = Vec3.zeros(motion.velocity.x)
    return Wrench(zero, zero)


@partial(jax.jit, static_argnames=("advance", "count", "wrench"))
def fly(advance: Step, count: int, start: Motion = TUMBLING, wrench: Callable = nothing) -> Motion:
    """Return the motion after a second of so many steps."""

    def step(_: int, motion: Motion) -> Motion:
        return advance(BODY, motion, wrench, 1.0 / count)

    return jax.lax.fori_loop(0, count, step, start)


def angular_momentum(motion: Motion) -> Vec3:
    rate = motion.body_rate
    body = Vec3(BODY.inertia_xx * rate.x, BODY.inertia_yy * rate.y, BODY.inertia_zz * rate.z)
    return motion.attitude.to_world(body)


def spin_energy(motion: Motion) -> float:
    rate = motion.body_rate
    turning = BODY.inertia_xx * rate.x**2 + BODY.inertia_yy * rate.y**2
    return float(0.5 * (turning + BODY.inertia_zz * rate.z**2))


def fall_energy(motion: Motion) -> float:
    moving = 0.5 * motion.velocity.dot(motion.velocity)
    return float(BODY.mass * (moving + GRAVITY * motion.position.z))


@pytest.mark.parametrize("advance", [step_midpoint, step_rk4])
def test_free_fall_is_exact(advance: Step) -> None:
    after = fly(advance, 100)
    assert apart(after.velocity, vec(1.0, 2.0, 3.0 - GRAVITY)) < 1e-12
    assert apart(after.position, vec(1.0, 2.0, 13.0 - GRAVITY / 2)) < 1e-12
    assert fall_energy(after) == pytest.approx(fall_energy(TUMBLING), rel=1e-13)


def test_free_fall_of_the_first_order_step_is_late_by_half_a_step() -> None:
    after = fly(step_semi_implicit, 100)
    assert float(after.position.z) == pytest.approx(13.0 - GRAVITY / 2 - GRAVITY * 0.005, rel=1e-12)


def test_torque_free_spin_keeps_energy_and_angular_momentum() -> None:
    after = fly(step_rk4, 1000)
    assert spin_energy(after) == pytest.approx(spin_energy(TUMBLING), rel=1e-11)
    assert apart(angular_momentum(after), angular_momentum(TUMBLING)) < 1e-11


@pytest.mark.parametrize(
    ("advance", "order"), [(step_semi_implicit, 1), (step_midpoint, 1), (step_rk4, 4)]
)
def test_spin_converges_to_what_is_kept(advance: Step, order: int) -> None:
    errors = [
        apart(angular_momentum(fly(advance, count)), angular_momentum(TUMBLING))
        for count in (100, 200)
    ]
    assert errors[0] / errors[1] > 0.8 * 2**order


def test_attitude_follows_a_constant_rate() -> None:
    """Spin about a principal axis: an exact answer."""
    spinning = Motion(vec(0, 0, 0), vec(0, 0, 0), quaternion(1, 0, 0, 0), vec(0.0, 0.0, 3.0))

    after = fly(step_midpoint, 1000, spinning)
    ahead = after.attitude.heading()
    assert float(np.arctan2(ahead.y, ahead.x)) == pytest.approx(3.0, abs=3e-6)
    assert float(after.body_rate.z) == 3.0


def push(_: Motion) -> Wrench:
    return Wrench(vec(0.0, 0.0, 20.0), vec(0.0, 0.06, 0.0))


@pytest.mark.parametrize(
    ("advance", "order"), [(step_semi_implicit, 1), (step_midpoint, 2), (step_rk4, 4)]
)
def test_order_of_each_step_under_a_moment(advance: Step, order: int) -> None:
    """A moment about a principal axis and thrust: what the midpoint step is made for."""
    still = Motion(vec(0, 0, 0), vec(1, 0, 0), quaternion(1, 0, 0, 0), vec(0.0, 0.5, 0.0))

    exact = fly(step_rk4, 2000, still, push)
    errors = [
        apart(fly(advance, count, still, push).position, exact.position) for count in (25, 50)
    ]
    assert errors[0] / errors[1] == pytest.approx(2**order, rel=0.15)

"""What pushes a vehicle does so by Newton's and Euler's laws, and costs nothing where it is not."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim_jax.environment import STILL_AIR, Disturbance, Environment
from sim_jax.geometry import Vec3
from sim_jax.inlet import RotorSpeedInlet
from sim_jax.rollout import Rollout, rollout
from sim_jax.schedule import Schedule
from sim_jax.state import hover
from tests.sim_jax.support import apart, controller, moving_start, vec, vehicle, wobble

SCHEDULE = Schedule(log_rate=400)
SAMPLES = 81
SECONDS = (SAMPLES - 1) / 400
TICKS = 40


def series(*values: float) -> Vec3:
    return Vec3(*(jnp.full(TICKS, float(value)) for value in values))


def acting(**parts: object) -> Environment:
    """Return what acts, of parts that are all there: those that are not named are zero."""
    none = Disturbance(series(0, 0, 0), series(0, 0, 0), jnp.zeros(TICKS), series(0, 0, 0))
    return Environment(disturbance=replace(none, **parts))  # type: ignore[arg-type]


@eqx.filter_jit
def fallen(around: Environment) -> Rollout:
    """Return the flight of a vehicle at rest whose rotors stand still, in nothing that drags."""
    craft = vehicle()
    still = RotorSpeedInlet(tuple(jnp.zeros(SAMPLES + 2) for _ in range(4)))
    start = hover(craft, vec(0.0, 0.0, 50.0))
    start = replace(start, rotor_speed=tuple(jnp.zeros(()) for _ in range(4)))
    return rollout(craft, controller(), SCHEDULE, still, start, samples=SAMPLES, environment=around)


def test_a_force_accelerates_by_newtons_law() -> None:
    pushed = fallen(acting(force=series(0.3, -0.2, 0.5)))
    free = fallen(STILL_AIR)
    mass = float(vehicle().body.mass)
    gained = pushed.log.motion.velocity - free.log.motion.velocity
    for axis, force in zip(gained.stacked()[:, -1], (0.3, -0.2, 0.5), strict=True):
        assert float(axis) == pytest.approx(force / mass * SECONDS, rel=1e-9)


def test_a_moment_turns_by_eulers_law_and_thrust_acts_along_the_bodys_axis() -> None:
    turned = fallen(acting(moment=series(0.0, 0.002, 0.0)))
    rate = float(turned.log.motion.body_rate.y[-1])
    assert rate == pytest.approx(0.002 / float(vehicle().body.inertia_yy) * SECONDS, rel=1e-9)
    lifted = fallen(acting(thrust=jnp.full(TICKS, 0.4)))
    gained = lifted.log.motion.velocity.z[-1] - fallen(STILL_AIR).log.motion.velocity.z[-1]
    assert float(gained) == pytest.approx(0.4 / float(vehicle().body.mass) * SECONDS, rel=1e-9)


def test_two_disturbances_together_are_the_sum_of_each_part() -> None:
    one = Disturbance(gust=series(1, 2, 3), thrust=jnp.full(TICKS, 0.4), rate=50.0)
    two = Disturbance(
        gust=series(4, 5, 6),
        force=series(1, 0, 2),
        thrust=jnp.full(TICKS, 0.5),
        moment=series(7, 8, 9),
    )
    both = Disturbance(
        gust=series(5, 7, 9),
        force=series(1, 0, 2),
        thrust=jnp.full(TICKS, 0.9),
        moment=series(7, 8, 9),
        rate=50.0,
    )
    assert apart(one.plus(two), both) < 1e-15
    assert one.plus(two).rate == both.rate
    assert apart(replace(two, rate=50.0).plus(one), both) < 1e-15


@eqx.filter_jit
def flown(around: Environment) -> Rollout:
    craft = vehicle()
    return rollout(
        craft,
        controller(),
        SCHEDULE,
        wobble(craft, SAMPLES + 2),
        moving_start(craft),
        samples=SAMPLES,
        environment=around,
    )


def test_a_steady_gust_is_a_wind() -> None:
    wind = vec(1.0, -0.5, 0.2)
    gust = acting(gust=series(1.0, -0.5, 0.2))
    assert apart(flown(gust).log, flown(Environment(wind)).log) < 1e-12


def test_a_disturbance_of_zero_moves_nothing() -> None:
    assert apart(flown(acting()).log, flown(STILL_AIR).log) < 1e-12


def test_values_are_linear_between_control_ticks() -> None:
    ramp = Disturbance(thrust=jnp.arange(TICKS) * 0.1)
    middle = ramp.during(jnp.asarray(5), SCHEDULE)  # 5.5 steps of four in a tick
    assert middle.thrust is not None
    assert float(middle.thrust) == pytest.approx(0.1 * 5.5 / 4)
    last = ramp.during(jnp.asarray(4 * TICKS + 7), SCHEDULE)
    assert last.thrust is not None
    assert float(last.thrust) == pytest.approx(0.1 * (TICKS - 1))


def test_ticks_of_their_own_rate_are_as_fine_as_that() -> None:
    rate = 2.0 * SCHEDULE.physics_rate
    ramp = Disturbance(thrust=jnp.arange(40) * 0.1, rate=rate)
    middle = ramp.during(jnp.asarray(5), SCHEDULE)  # 5.5 steps of two ticks
    assert middle.thrust is not None
    assert float(middle.thrust) == pytest.approx(0.1 * 11.0)


def test_a_flights_derivative_by_a_push_is_finite() -> None:
    def end(thrust: jax.Array) -> jax.Array:
        around = Environment(disturbance=Disturbance(thrust=thrust))
        return flown(around).log.motion.position.z[-1]

    slope = jax.jvp(end, (jnp.zeros(TICKS),), (jnp.ones(TICKS),))[1]
    assert np.isfinite(float(slope))
    assert float(slope) > 0.0

"""Flights that end badly stay finite, say when, and leave the rest of the batch alone."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import pytest

from sim_jax.inlet import ActuatorInlet, ReferenceInlet
from sim_jax.rigid_body import Motion
from sim_jax.rollout import Rollout
from sim_jax.schedule import Schedule
from sim_jax.state import AIRBORNE, Limits, hover
from sim_jax.vehicle import Vehicle
from tests.sim_jax.support import (
    apart,
    at_first_point,
    compiled_rollout,
    controller,
    finite,
    quaternion,
    reference,
    vec,
    vehicle,
)

SAMPLES = 300
POINTS = reference("circle", ticks=SAMPLES)


def fly(craft: Vehicle, limits: Limits | None = None, samples: int = SAMPLES) -> Rollout:
    return compiled_rollout(  # type: ignore[no-any-return]
        craft,
        controller(),
        Schedule(),
        ReferenceInlet(POINTS),
        at_first_point(vehicle(), POINTS),
        samples=samples,
        limits=limits,
    )


def with_motor_constants(*values: float) -> Vehicle:
    return eqx.tree_at(lambda v: v.aerodynamics.motor_constant, vehicle(), jnp.asarray(values))  # type: ignore[no-any-return]


GOOD, WEAK = 1.45e-5, 1e-6


def test_a_vehicle_that_sinks_is_frozen_on_the_ground_at_the_right_time() -> None:
    flown = fly(with_motor_constants(WEAK, GOOD, GOOD, GOOD))
    height = flown.log.motion.position.z[:, 0]
    crash = float(flown.crash_time[0])
    step = round(crash * 100)
    assert 0.2 < crash < 1.0
    assert float(height[step - 1]) > 0.227
    assert apart(height[step + 2 :], height[-1]) == 0.0
    assert float(height[-1]) == pytest.approx(0.227, abs=0.03)
    speed = flown.log.rotor_speed[0][:, 0]
    assert apart(speed[step + 2 :], speed[-1]) == 0.0


def test_a_crash_after_the_last_sample_is_none() -> None:
    weak = with_motor_constants(*(WEAK * share for share in (0.7, 1.0, 1.3, 2.0)))
    crash = fly(weak).crash_time
    step = round(float(crash[0]) * 100)
    before = crash <= step / 100
    assert before.tolist() == [True, False, False, False]
    assert round(float(crash[1]) * 100) == step + 1
    assert fly(weak, samples=step).crashed.tolist() == before.tolist()


@pytest.mark.parametrize(
    ("place", "rate", "limits", "crashes"),
    [
        ((0.0, 0.0, 0.226), (0.0, 0.0, 0.0), Limits(), True),
        ((0.0, 0.0, 0.3), (0.0, 0.0, 0.0), Limits(), False),
        ((50.1, 0.0, 5.0), (0.0, 0.0, 0.0), Limits(), True),
        ((0.0, -49.0, 5.0), (0.0, 0.0, 0.0), Limits(), False),
        ((0.0, 0.0, 5.0), (61.0, 0.0, 0.0), Limits(), True),
        ((0.0, 0.0, -5.0), (0.0, 0.0, 0.0), AIRBORNE, False),
        ((0.0, 0.0, -5.0), (0.0, -61.0, 0.0), AIRBORNE, True),
        ((float("nan"), 0.0, 5.0), (0.0, 0.0, 0.0), Limits(), True),
    ],
)
def test_limits(place: tuple, rate: tuple, limits: Limits, crashes: bool) -> None:
    motion = Motion(vec(*place), vec(0, 0, 0), quaternion(1, 0, 0, 0), vec(*rate))
    assert bool(limits.broken_by(motion)) is crashes


def test_a_tumbling_vehicle_is_caught() -> None:
    craft = vehicle()
    level = hover(craft, vec(0.0, 0.0, 20.0))
    uneven = ActuatorInlet(
        tuple(jnp.full(400, value) for value in (1.0, 0.0, 0.0, 1.0))  # type: ignore[arg-type]
    )
    flown = compiled_rollout(craft, controller(), Schedule(), uneven, level, samples=100)
    assert bool(flown.crashed)
    assert finite(flown.log)
    assert float(jnp.max(jnp.abs(flown.log.motion.body_rate.x))) < 70.0

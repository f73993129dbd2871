"""Six and eight rotors through the inlets below the mixer: what they keep, and how they yaw."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim_jax.constants import GRAVITY
from sim_jax.geometry import Vec3
from sim_jax.inlet import ActuatorInlet, BodyRateInlet, Inlet, ReferenceInlet, RotorSpeedInlet
from sim_jax.rollout import Rollout
from sim_jax.schedule import Schedule
from sim_jax.state import Start, hover
from sim_jax.vehicle import Rotor, Vehicle
from tests.sim_jax.support import (
    apart,
    at_first_point,
    compiled_rollout,
    controller,
    quaternion,
    reference,
    vec,
    vehicle,
    without_losses,
)

COUNTS = [6, 8]
STEPS = 200
SCHEDULE = Schedule(log_rate=400)


def round_airframe(count: int) -> Vehicle:
    """Return the thesis's vehicle with rotors evenly on a circle, turning in turns."""
    angles = 2.0 * np.pi * (np.arange(count) + 0.5) / count
    rotors = tuple(
        Rotor(vec(0.3 * np.cos(angle), 0.3 * np.sin(angle), 0.05), 1 if number % 2 == 0 else -1)
        for number, angle in enumerate(angles)
    )
    craft = eqx.tree_at(lambda v: v.body.inertia_yy, vehicle(), vehicle().body.inertia_xx)
    return Vehicle(craft.body, rotors, craft.motor, craft.aerodynamics, craft.setup)


def constant(values: tuple, steps: int = STEPS) -> tuple:
    return tuple(jnp.full(steps + 2, value) for value in values)


def fly(craft: Vehicle, inlet: Inlet, start: Start) -> Rollout:
    return compiled_rollout(craft, controller(), SCHEDULE, inlet, start, samples=STEPS)  # type: ignore[no-any-return]


@pytest.mark.parametrize("count", COUNTS)
def test_hover_commands_hold_the_vehicle_where_it_is(count: int) -> None:
    craft = round_airframe(count)
    start = hover(craft, vec(0.0, 0.0, 5.0))
    flown = fly(craft, ActuatorInlet(constant(start.command)), start).log
    assert len(flown.rotor_speed) == count
    last = jax.tree.map(lambda leaf: leaf[-1], flown.motion)
    assert apart(last, start.motion) < 1e-9


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("sense", [1, -1])
def test_faster_rotors_of_one_sense_yaw_the_vehicle_the_other_way(count: int, sense: int) -> None:
    """And at the rate of their drag torque, in N m s: what the rotors give, the body takes up."""
    craft = without_losses(round_airframe(count))
    start = hover(craft, vec(0.0, 0.0, 5.0))
    commands = tuple(
        command + 0.02 * sense * rotor.spin
        for command, rotor in zip(start.command, craft.rotors, strict=True)
    )
    flown = fly(craft, ActuatorInlet(constant(commands)), start).log
    rate = flown.motion.body_rate
    assert float(rate.z[-1]) * sense < -0.1
    assert float(jnp.max(jnp.abs(rate.x))) < 1e-9

    torque = -craft.aerodynamics.motor_constant * craft.aerodynamics.moment_constant
    square = sum(
        rotor.spin * speed**2 for rotor, speed in zip(craft.rotors, flown.rotor_speed, strict=True)
    )
    given = jnp.cumsum(0.5 * (square[1:] + square[:-1])) * torque * SCHEDULE.step
    taken = craft.body.inertia_zz * rate.z[1:]
    np.testing.assert_allclose(taken, given, rtol=2e-2, atol=1e-6)


@pytest.mark.parametrize("count", COUNTS)
def test_work_of_the_thrust_becomes_energy(count: int) -> None:
    craft = without_losses(round_airframe(count))
    start = hover(craft, vec(0.0, 0.0, 5.0))
    speeds = tuple(1.1 * speed for speed in start.rotor_speed)
    flown = fly(craft, RotorSpeedInlet(constant(speeds)), start).log.motion
    thrust = 1.1**2 * craft.body.mass * GRAVITY
    climbed, speed = flown.position.z[-1] - 5.0, flown.velocity.z[-1]
    energy = craft.body.mass * (0.5 * speed**2 + GRAVITY * climbed)
    assert float(energy) == pytest.approx(float(thrust * climbed), rel=1e-9)
    assert float(climbed) > 0.1


@pytest.mark.parametrize("count", COUNTS)
def test_turned_to_the_next_rotor_but_one_the_airframe_is_the_same(count: int) -> None:
    """Rotors alternate: two places on, each stands where one of its own sense stood."""
    craft = round_airframe(count)
    start = hover(craft, vec(0.0, 0.0, 5.0))
    time = jnp.arange(STEPS + 2) * SCHEDULE.step
    commands = tuple(
        command + 0.01 * jnp.sin((7.0 + number) * time)
        for number, command in enumerate(start.command)
    )
    half = 2.0 * np.pi / count
    turn = quaternion(np.cos(half), 0.0, 0.0, np.sin(half))
    here = fly(craft, ActuatorInlet(commands), start).log.motion
    there = fly(craft, ActuatorInlet((*commands[-2:], *commands[:-2])), start).log.motion
    seen = Vec3(here.position.x, here.position.y, here.position.z)
    assert apart(there.position, turn.to_world(seen)) < 1e-9
    assert apart(there.body_rate, turn.to_world(here.body_rate)) < 1e-9
    assert float(jnp.max(jnp.abs(here.body_rate.x))) > 0.01


@pytest.mark.parametrize("count", COUNTS)
def test_mixer_refuses_more_rotors_than_it_commands(count: int) -> None:
    craft = round_airframe(count)
    points = reference("circle", ticks=5)
    rates = jnp.zeros(STEPS)
    for inlet in (ReferenceInlet(points), BodyRateInlet(Vec3(rates, rates, rates), rates + 0.5)):
        with pytest.raises(ValueError, match=f"has {count} rotors, and PX4's quad-X mixer"):
            fly(craft, inlet, at_first_point(craft, points))


def test_values_for_another_number_of_rotors_are_refused() -> None:
    craft = round_airframe(6)
    start = hover(craft, vec(0.0, 0.0, 5.0))
    with pytest.raises(ValueError, match="has 6 rotors, the inlet has values for 4"):
        fly(craft, ActuatorInlet(constant(start.command[:4])), start)
    with pytest.raises(ValueError, match="has 6 rotors, the start has values for 4"):
        fly(craft, ActuatorInlet(constant(start.command)), hover(vehicle(), vec(0.0, 0.0, 5.0)))

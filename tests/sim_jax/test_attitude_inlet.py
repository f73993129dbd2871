"""Attitude fed in, translation simulated: the same path as the whole simulation's, whatever turns.

Derivatives of that path are those of finite differences, and exactly zero by what only turns.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

from sim_jax.inlet import ActuatorInlet, AttitudeInlet, Inlet, MixedInlet, RotorSpeedInlet
from sim_jax.plant import Sample
from sim_jax.schedule import Schedule
from sim_jax.vehicle import Vehicle
from tests.sim_jax.support import (
    apart,
    compiled_rollout,
    controller,
    moving_start,
    vehicle,
    wobble,
)

SAMPLES = 400
CRAFT = vehicle()
START = moving_start(CRAFT)
COMMANDS = wobble(CRAFT, SAMPLES + 1)


def fly(craft: Vehicle, inlet: Inlet) -> Sample:
    schedule = Schedule(log_rate=400)
    return compiled_rollout(craft, controller(), schedule, inlet, START, samples=SAMPLES).log  # type: ignore[no-any-return]


def following(flown: Sample, drive: Inlet) -> AttitudeInlet:
    """Return an inlet that follows a flight's attitude; its last sample repeats."""
    held = jax.tree.map(
        lambda leaf: jnp.concatenate([leaf, leaf[-1:]]),
        (flown.motion.attitude, flown.motion.body_rate),
    )
    return AttitudeInlet(*held, drive)


@pytest.fixture(scope="module")
def flown() -> Sample:
    return fly(CRAFT, COMMANDS)


def test_translation_is_that_of_the_simulation_whose_attitude_is_fed_in(flown: Sample) -> None:
    again = fly(CRAFT, following(flown, COMMANDS))
    assert float(jnp.max(jnp.abs(flown.motion.position.x - START.motion.position.x))) > 0.3
    assert apart(again.motion, flown.motion) < 1e-7
    assert apart(again.rotor_speed, flown.rotor_speed) < 1e-9


def test_measured_rotor_speeds_drive_it_as_well(flown: Sample) -> None:
    speeds = tuple(jnp.concatenate([leaf, leaf[-1:]]) for leaf in flown.rotor_speed)
    again = fly(CRAFT, following(flown, RotorSpeedInlet(speeds)))
    # between samples a measured speed is taken to be straight, which a lag is not
    assert apart(again.motion, flown.motion) < 2e-4


def test_it_shares_a_batch_with_another_inlet(flown: Sample) -> None:
    parts = (following(flown, COMMANDS), ActuatorInlet(COMMANDS.command))
    heavier = eqx.tree_at(lambda v: v.body.inertia_xx, CRAFT, CRAFT.body.inertia_xx * 1.3)
    together = fly(heavier, MixedInlet(parts, jnp.asarray([0, 1])))
    for number, part in enumerate(parts):
        mine = jax.tree.map(lambda leaf, at=number: leaf[:, at], together.motion)
        assert apart(mine, fly(heavier, part).motion) < 1e-12


def numbers(craft: Vehicle) -> dict[str, Array]:
    body, motor, air = craft.body, craft.motor, craft.aerodynamics
    return {
        "motor_constant": air.motor_constant,
        "rotor_drag_coefficient": air.rotor_drag_coefficient,
        "input_scaling": motor.input_scaling,
        "time_constant_up": motor.time_constant_up,
        "mass": body.mass,
        "inertia_xx": body.inertia_xx,
        "inertia_yy": body.inertia_yy,
        "inertia_zz": body.inertia_zz,
        "moment_constant": air.moment_constant,
        "rolling_moment_coefficient": air.rolling_moment_coefficient,
    }


TURNS = tuple(list(numbers(CRAFT))[5:])
"""What only turns the vehicle."""


@pytest.fixture(scope="module")
def slopes(flown: Sample) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return number -> derivative and difference of where a flight ends, by the number's share."""
    inlet, step = following(flown, COMMANDS), 1e-4
    names, start = list(numbers(CRAFT)), jnp.stack(list(numbers(CRAFT).values()))

    def end(shares: Array) -> Array:
        craft = eqx.tree_at(lambda v: list(numbers(v).values()), CRAFT, list(start * shares))
        motion = fly(craft, inlet).motion
        return jnp.stack([motion.position.stacked()[:, -1], motion.velocity.stacked()[:, -1]])

    one, moves = jnp.ones(len(names)), step * jnp.eye(len(names))
    slope = jnp.moveaxis(jax.jit(jax.jacfwd(end))(one), -1, 0)
    ends = jax.jit(jax.vmap(end))(jnp.concatenate([one + moves, one - moves]))
    difference = (ends[: len(names)] - ends[len(names) :]) / (2 * step)
    return dict(
        zip(names, zip(np.asarray(slope), np.asarray(difference), strict=True), strict=True)
    )


@pytest.mark.parametrize("name", numbers(CRAFT))
def test_derivatives_are_finite_differences_and_zero_by_what_only_turns(
    slopes: dict[str, tuple[np.ndarray, np.ndarray]], name: str
) -> None:
    slope, difference = slopes[name]
    if name in TURNS:
        assert np.all(slope == 0.0)
        return
    assert np.abs(slope).max() > 1e-4
    np.testing.assert_allclose(slope, difference, rtol=1e-3, atol=1e-7)  # lags switch

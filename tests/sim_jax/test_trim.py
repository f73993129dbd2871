"""A vehicle that starts in trim stays where it is, however uneven its rotors are."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim_jax.control.gains import MixerSettings
from sim_jax.control.mixer import mix, torque_of
from sim_jax.inlet import ReferenceInlet
from sim_jax.motor import command_of, reference_speed
from sim_jax.schedule import Schedule
from sim_jax.state import hover
from sim_jax.trim import trim_speeds, trimmed_start
from tests.sim_jax.support import compiled_rollout, controller, reference, vec, vehicle

UNEVEN = {
    "center_of_mass_x": 0.003,
    "center_of_mass_y": -0.002,
    "center_of_mass_z": 0.015,
    "rotor_thrust_scale_1": 1.02,
    "rotor_thrust_scale_2": 0.985,
    "rotor_thrust_scale_3": 0.99,
    "torque_trim_z": 0.01,
    "thrust_exponent": 1.9,
}
AT_REST = jnp.asarray(True)


def uneven(**effects):
    return replace(vehicle(), effects={name: jnp.asarray(v) for name, v in effects.items()})


def drift(craft, start):
    """Return how far, in m, a vehicle moves sideways in two seconds of hover."""
    inlet = ReferenceInlet(reference("hover", ticks=200))
    flown = compiled_rollout(craft, controller(), Schedule(), inlet, start, samples=200)
    place = flown.log.motion.position
    return max(float(jnp.abs(axis - axis[0]).max()) for axis in (place.x, place.y))


def test_an_uneven_vehicle_in_trim_stays_and_without_trim_moves():
    craft = uneven(**UNEVEN)
    level = hover(craft, vec(0.0, 0.0, 1.0))
    trimmed = trimmed_start(craft, controller(), level, AT_REST)
    assert drift(craft, trimmed) < 1e-4
    assert drift(craft, level) > 1e-3


def test_a_battery_asks_for_larger_commands_and_the_same_speeds():
    craft = uneven(**UNEVEN)
    level = hover(craft, vec(0.0, 0.0, 1.0))
    full = trimmed_start(craft, controller(), level, AT_REST)
    low = trimmed_start(craft, controller(), level, AT_REST, speed_factor=jnp.asarray(0.95))
    np.testing.assert_allclose(low.rotor_speed, full.rotor_speed, rtol=1e-12)
    for speed, command in zip(low.rotor_speed, low.command, strict=True):
        assert 0.95 * reference_speed(craft.motor, command) == pytest.approx(speed)


def test_an_even_vehicle_rests_whatever_its_first_command_answers():
    level = hover(vehicle(), vec(0.0, 0.0, 1.0))
    pushed = replace(level, command=tuple(command + 0.2 for command in level.command))
    trimmed = trimmed_start(vehicle(), controller(), pushed, AT_REST)
    for kept, held in zip(jax.tree.leaves(trimmed), jax.tree.leaves(level), strict=True):
        np.testing.assert_allclose(kept, held, atol=1e-12)


def test_a_moving_vehicle_starts_as_recorded():
    level = hover(vehicle(), vec(0.0, 0.0, 1.0))
    moving = trimmed_start(uneven(**UNEVEN), controller(), level, jnp.asarray(False))
    for kept, recorded in zip(jax.tree.leaves(moving), jax.tree.leaves(level), strict=True):
        np.testing.assert_array_equal(kept, recorded)
    np.testing.assert_allclose(trim_speeds(vehicle()), hover(vehicle(), vec(0, 0, 1)).rotor_speed)


@jax.jit
def speeds_and_slopes(effects):
    """Return rotor speeds in trim, and their derivatives by each effect."""

    def speeds(effects):
        return jnp.stack(trim_speeds(uneven(**effects)))

    return speeds(effects), jax.jacfwd(speeds)(effects)


@pytest.mark.parametrize("name", sorted(UNEVEN))
def test_trim_has_the_derivative_that_differences_have(name):
    step = 1e-5
    below, above = (
        speeds_and_slopes(UNEVEN | {name: UNEVEN[name] + way * step})[0] for way in (-1, 1)
    )
    slope = speeds_and_slopes(UNEVEN)[1][name]
    np.testing.assert_allclose(slope, (above - below) / (2 * step), rtol=1e-5, atol=1e-3)


@pytest.mark.parametrize("factor", [0.0, 0.3])
def test_commands_tell_the_torque_that_they_were_mixed_from(factor):
    settings = MixerSettings(thrust_factor=factor)
    torque = vec(0.03, -0.02, 0.01)
    back = torque_of(settings, mix(settings, torque, jnp.asarray(0.5)))
    np.testing.assert_allclose([back.x, back.y, back.z], [0.03, -0.02, 0.01], atol=1e-7)


@pytest.mark.parametrize("quadratic", [0.0, 150.0, -200.0])
def test_a_rotor_speed_has_one_command(quadratic):
    motor = replace(vehicle().motor, quadratic=jnp.asarray(quadratic))
    for command in map(jnp.asarray, (0.2, 0.5, 0.8)):
        assert command_of(motor, reference_speed(motor, command)) == pytest.approx(command)


def test_a_hover_has_the_command_that_its_motors_turn_the_rotors_by():
    motor = replace(vehicle().motor, quadratic=jnp.asarray(-150.0), input_offset=jnp.asarray(0.05))
    start = hover(replace(vehicle(), motor=motor), vec(0.0, 0.0, 1.0))
    asked = [reference_speed(motor, command) for command in start.command]
    np.testing.assert_allclose(asked, start.rotor_speed, rtol=1e-12)

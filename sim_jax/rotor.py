"""Rotor speed and air velocity to force and moment (Eq. 6.5, 6.6, 7.2, 8.2, 9.2)."""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp

from sim_jax.numeric import Scalar
from sim_jax.vector import Vec3
from sim_jax.vehicle import Aerodynamics, Rotor


class Wrench(eqx.Module):
    """Force in N and moment in N m about the centre of mass, both in body axes."""

    force: Vec3
    moment: Vec3


def vehicle_wrench(
    aerodynamics: Aerodynamics,
    rotors: Sequence[Rotor],
    *,
    speeds: Sequence[Scalar],
    air_velocity: Vec3,
    body_rate: Vec3,
    world_up: Vec3,
) -> Wrench:
    """Sum the rotors' forces and moments about the centre of mass, in body axes.

    Each rotor at r, turning with Ω, moves through the air with v = air_velocity + ω × r. It gives
    thrust motor_constant·Ω²·clip(1 - |v∥|/max_relative_airspeed, 0, 1) along body z, rotor drag
    -rotor_drag_coefficient·Ω·v⊥, drag torque -spin·moment_constant·motor_constant·Ω² and rolling
    moment -rolling_moment_coefficient·spin·Ω·v⊥. Torque and rolling moment are summed before their
    coefficients multiply them, which are the same for all; forces are not, so that opposite ones
    cancel to the last bit.

    Parameters
    ----------
    aerodynamics
        Coefficients, the same for every rotor.
    rotors
        Position and spin of each.
    speeds
        Ω of each in rad/s.
    air_velocity
        Velocity of the centre of mass through the air in m/s, body axes.
    body_rate
        rad/s, body axes.
    world_up
        World z in body axes.
    """
    thrust, drag = aerodynamics.motor_constant, aerodynamics.rotor_drag_coefficient
    force = moment = Vec3.zeros(air_velocity.x)
    square, across_x, across_y = (jnp.zeros_like(air_velocity.x) for _ in range(3))
    for rotor, speed in zip(rotors, speeds, strict=True):
        through = air_velocity + body_rate.cross(rotor.position)
        along_x, along_y = speed * through.x, speed * through.y
        lift = speed * speed * _remaining(aerodynamics, through.z)
        own = Vec3(-drag * along_x, -drag * along_y, thrust * lift)
        force, moment = force + own, moment + rotor.position.cross(own)
        square = square + rotor.spin * (speed * speed)
        across_x, across_y = across_x + rotor.spin * along_x, across_y + rotor.spin * along_y
    torque = -thrust * aerodynamics.moment_constant * square
    rolling = aerodynamics.rolling_moment_coefficient
    moment = moment - Vec3(rolling * across_x, rolling * across_y, jnp.zeros_like(torque))
    if aerodynamics.reaction_torque == "world":
        return Wrench(force, moment + world_up * torque)
    return Wrench(force, Vec3(moment.x, moment.y, moment.z + torque))


def _remaining(aerodynamics: Aerodynamics, axial: Scalar) -> Scalar:
    """Return the share of a rotor's static thrust that is left at an axial air speed in m/s."""
    lost = jnp.abs(axial) * (1.0 / aerodynamics.max_relative_airspeed)
    return jnp.where(lost < 1.0, 1.0 - lost, 0.0)

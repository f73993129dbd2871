"""Rotor speed and air velocity to force and moment (Eq. 6.5, 6.6, 7.2, 8.2, 9.2)."""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp

from sim_jax.numeric import Scalar, saturate
from sim_jax.vector import Vec3
from sim_jax.vehicle import Aerodynamics, Rotor


class Wrench(eqx.Module):
    """Force in N and moment in N m about the centre of mass, both in body axes."""

    force: Vec3
    moment: Vec3


def rotor_wrench(
    aerodynamics: Aerodynamics,
    *,
    spin: int,
    speed: Scalar,
    air_velocity: Vec3,
    world_up: Vec3 | None = None,
) -> Wrench:
    """Return force and moment of one rotor at its own centre.

    Parameters
    ----------
    aerodynamics
        The rotor's coefficients.
    spin
        +1 counter-clockwise, -1 clockwise.
    speed
        Ω in rad/s.
    air_velocity
        Velocity of the rotor centre through the air in m/s, body axes.
    world_up
        World z in body axes; needed where the reaction torque acts about it.

    Returns
    -------
    Wrench
        Thrust motor_constant·Ω²·clip(1 - |v∥|/max_relative_airspeed, 0, 1) along body z, rotor drag
        -Ω·rotor_drag_coefficient·v⊥, drag torque -spin·moment_constant·motor_constant·Ω², rolling
        moment -spin·Ω·rolling_moment_coefficient·v⊥.
    """
    static_thrust = aerodynamics.motor_constant * (speed * speed)
    axial = jnp.where(air_velocity.z < 0, -air_velocity.z, air_velocity.z)
    remaining = saturate(1.0 - axial / aerodynamics.max_relative_airspeed, 0.0, 1.0)
    drag = -aerodynamics.rotor_drag_coefficient * speed
    rolling = -spin * aerodynamics.rolling_moment_coefficient * speed
    torque = -spin * aerodynamics.moment_constant * static_thrust
    moment = Vec3(rolling * air_velocity.x, rolling * air_velocity.y, jnp.zeros_like(torque))
    axis = Vec3(torque * 0.0, torque * 0.0, torque) if world_up is None else world_up * torque
    return Wrench(
        force=Vec3(drag * air_velocity.x, drag * air_velocity.y, static_thrust * remaining),
        moment=moment + axis,
    )


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
    about = world_up if aerodynamics.reaction_torque == "world" else None
    zero = jnp.zeros_like(air_velocity.x)
    force = moment = Vec3(zero, zero, zero)
    for rotor, speed in zip(rotors, speeds, strict=True):
        one = rotor_wrench(
            aerodynamics,
            spin=rotor.spin,
            speed=speed,
            air_velocity=air_velocity + body_rate.cross(rotor.position),
            world_up=about,
        )
        force = force + one.force
        moment = moment + one.moment + rotor.position.cross(one.force)
    return Wrench(force, moment)

"""The base model's four terms, those of Gazebo's motor model: all that acts at a rotor.

A rotor at the arm r, turning with Ω > 0 in the sense of its spin s, moves through the air with v:
v∥ along its axis, which is body z, and v⊥ across it.
"""

from __future__ import annotations

import jax.numpy as jnp

from sim_jax.numeric import Scalar
from sim_jax.rigid_body import Motion, Wrench
from sim_jax.terms.air import Air
from sim_jax.vector import Vec3
from sim_jax.vehicle import Aerodynamics, PerRotor, Vehicle


def thrust(vehicle: Vehicle, motion: Motion, rotor_speed: PerRotor, air: Air) -> Wrench:
    """Return motor_constant·Ω²·clip(1 - |v∥|/max_relative_airspeed, 0, 1) along body z, at r.

    Source: thesis Eq. 6.5 and 6.6. The equation is signed; the code that was flown, followed here,
    takes the length of v∥.
    """
    aerodynamics = vehicle.aerodynamics
    zero = jnp.zeros_like(motion.velocity.x)

    def lift(speed: Scalar, through: Vec3) -> Vec3:
        square = speed * speed * _remaining_share(aerodynamics, through.z)
        return Vec3(zero, zero, aerodynamics.motor_constant * square)

    lifts = (lift(speed, v) for speed, v in zip(rotor_speed, air.at_rotors, strict=True))
    return Wrench.at_each_rotor(tuple(lifts))


def rotor_drag(vehicle: Vehicle, motion: Motion, rotor_speed: PerRotor, air: Air) -> Wrench:
    """Return -rotor_drag_coefficient·Ω·v⊥, at r.

    Source: thesis Eq. 7.2.
    """
    coefficient = vehicle.aerodynamics.rotor_drag_coefficient
    zero = jnp.zeros_like(motion.velocity.x)

    def drag(speed: Scalar, through: Vec3) -> Vec3:
        return Vec3(-coefficient * (speed * through.x), -coefficient * (speed * through.y), zero)

    drags = (drag(speed, v) for speed, v in zip(rotor_speed, air.at_rotors, strict=True))
    return Wrench.at_each_rotor(tuple(drags))


def rolling_moment(vehicle: Vehicle, motion: Motion, rotor_speed: PerRotor, air: Air) -> Wrench:
    """Return the moment -s·rolling_moment_coefficient·Ω·v⊥.

    Source: thesis Eq. 9.2.
    """
    coefficient = vehicle.aerodynamics.rolling_moment_coefficient
    x = y = zero = jnp.zeros_like(motion.velocity.x)
    for rotor, speed, through in zip(vehicle.rotors, rotor_speed, air.at_rotors, strict=True):
        x, y = x + rotor.spin * (speed * through.x), y + rotor.spin * (speed * through.y)
    return Wrench(Vec3.zeros(zero), Vec3(-coefficient * x, -coefficient * y, zero))


def drag_torque(vehicle: Vehicle, motion: Motion, rotor_speed: PerRotor, air: Air) -> Wrench:
    """Return the moment -s·moment_constant·motor_constant·Ω² about body z.

    The thrust in it is that without axial speed, as in Gazebo. The thesis's branch turns about
    world z instead (``reaction_torque``). Source: thesis Eq. 8.2.
    """
    aerodynamics = vehicle.aerodynamics
    square = zero = jnp.zeros_like(motion.velocity.x)
    for rotor, speed in zip(vehicle.rotors, rotor_speed, strict=True):
        square = square + rotor.spin * (speed * speed)
    torque = -aerodynamics.motor_constant * aerodynamics.moment_constant * square
    if aerodynamics.reaction_torque == "world":
        return Wrench(Vec3.zeros(zero), air.up * torque)
    return Wrench(Vec3.zeros(zero), Vec3(zero, zero, torque))


def _remaining_share(aerodynamics: Aerodynamics, axial: Scalar) -> Scalar:
    """Return the share of a rotor's static thrust that is left at an axial air speed in m/s."""
    lost = jnp.abs(axial) * (1.0 / aerodynamics.max_relative_airspeed)
    return jnp.where(lost < 1.0, 1.0 - lost, 0.0)

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
    moment -rolling_moment_coefficient·spin·Ω·v⊥. The coefficients are the same for all, so that
    they multiply sums over rotors.

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
    at = [rotor.position for rotor in rotors]
    x, y, z = [r.x for r in at], [r.y for r in at], [r.z for r in at]
    spin = [rotor.spin for rotor in rotors]
    through = [air_velocity + body_rate.cross(r) for r in at]
    along_x = [speed * v.x for speed, v in zip(speeds, through, strict=True)]
    along_y = [speed * v.y for speed, v in zip(speeds, through, strict=True)]
    square = [speed * speed for speed in speeds]
    lift = [s * _remaining(aerodynamics, v.z) for s, v in zip(square, through, strict=True)]

    thrust, drag = aerodynamics.motor_constant, aerodynamics.rotor_drag_coefficient
    rolling = aerodynamics.rolling_moment_coefficient
    torque = -thrust * aerodynamics.moment_constant * _sum(square, spin)
    force = Vec3(-drag * _sum(along_x), -drag * _sum(along_y), thrust * _sum(lift))
    moment = Vec3(
        thrust * _sum(lift, y) + drag * _sum(along_y, z) - rolling * _sum(along_x, spin),
        -thrust * _sum(lift, x) - drag * _sum(along_x, z) - rolling * _sum(along_y, spin),
        drag * (_sum(along_x, y) - _sum(along_y, x)),
    )
    if aerodynamics.reaction_torque == "world":
        return Wrench(force, moment + world_up * torque)
    return Wrench(force, Vec3(moment.x, moment.y, moment.z + torque))


def _remaining(aerodynamics: Aerodynamics, axial: Scalar) -> Scalar:
    """Return the share of a rotor's static thrust that is left at an axial air speed in m/s."""
    lost = jnp.abs(axial) * (1.0 / aerodynamics.max_relative_airspeed)
    return jnp.where(lost < 1.0, 1.0 - lost, 0.0)


def _sum(values: Sequence[Scalar], weights: Sequence[Scalar | int] | None = None) -> Scalar:
    """Return the sum over rotors, weighted by where they sit or which way they turn."""
    first, *others = (
        values
        if weights is None
        else [weight * value for weight, value in zip(weights, values, strict=True)]
    )
    for other in others:
        first = first + other
    return first

"""Force and moment to motion: six degrees of freedom, one integration step."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import equinox as eqx

from sim_jax.constants import GRAVITY
from sim_jax.geometry import Quaternion, Vec3
from sim_jax.vehicle import Body


class Motion(eqx.Module):
    """Where the body is and how it moves.

    Attributes
    ----------
    position, velocity
        m and m/s, world ENU.
    attitude
        Body to world.
    body_rate
        rad/s, body FLU.
    """

    position: Vec3
    velocity: Vec3
    attitude: Quaternion
    body_rate: Vec3


class Wrench(eqx.Module):
    """Force and moment, in body axes.

    Attributes
    ----------
    force
        N, at the centre of mass.
    moment
        N m, about the centre of mass.
    at_rotors
        N, forces that act at the centre of each rotor; they are not part of the other two.
    """

    force: Vec3
    moment: Vec3
    at_rotors: tuple[Vec3, ...] = ()

    @staticmethod
    def at_each_rotor(forces: tuple[Vec3, ...]) -> Wrench:
        """Return forces in N at the rotors alone."""
        zero = Vec3.zeros(forces[0].x)
        return Wrench(zero, zero, forces)


WrenchAt: TypeAlias = Callable[[Motion], Wrench]
"""Motion -> what acts in it on the centre of mass."""

Integrator: TypeAlias = Callable[..., Motion]
"""(body, motion, wrench_at, step in s, gravity in m/s²) -> the motion a step later."""


def acceleration(
    body: Body, attitude: Quaternion, force: Vec3, *, gravity: float = GRAVITY
) -> Vec3:
    """Return dv/dt in m/s², world, from a force in body axes (Newton)."""
    pull = attitude.to_world(force * (1.0 / body.mass))
    return Vec3(pull.x, pull.y, pull.z - gravity)


def angular_acceleration(body: Body, body_rate: Vec3, moment: Vec3) -> Vec3:
    """Return dω/dt in rad/s², body axes: I⁻¹(M - ω × Iω) (Euler)."""
    momentum = Vec3(
        body.inertia_xx * body_rate.x, body.inertia_yy * body_rate.y, body.inertia_zz * body_rate.z
    )
    net = moment - body_rate.cross(momentum)
    # one over an inertia stays the same, so that the compiled loop divides once a rollout
    return Vec3(
        net.x * (1.0 / body.inertia_xx),
        net.y * (1.0 / body.inertia_yy),
        net.z * (1.0 / body.inertia_zz),
    )


def step_semi_implicit(
    body: Body, motion: Motion, wrench_at: WrenchAt, step: float, *, gravity: float = GRAVITY
) -> Motion:
    """Advance as Gazebo's engine does: velocities first, then positions with the new velocities.

    First order in the step. ``step`` in s, ``gravity`` in m/s².
    """
    wrench = wrench_at(motion)
    pull = acceleration(body, motion.attitude, wrench.force, gravity=gravity)
    velocity = motion.velocity + pull * step
    body_rate = (
        motion.body_rate + angular_acceleration(body, motion.body_rate, wrench.moment) * step
    )
    return Motion(
        position=motion.position + velocity * step,
        velocity=velocity,
        attitude=motion.attitude.advanced(motion.attitude, body_rate, step),
        body_rate=body_rate,
    )


def step_midpoint(
    body: Body, motion: Motion, wrench_at: WrenchAt, step: float, *, gravity: float = GRAVITY
) -> Motion:
    """Advance with force and moment taken at mid-step: two evaluations, second order.

    The rotors' drag turns the vehicle as it slows it: taken before the step instead, it alone
    shifts a 4 m/s lemniscate by half a millimetre and its body rates by 0.003 rad/s at 400 Hz,
    which a fit takes for other time constants. ``step`` in s, ``gravity`` in m/s².
    """
    half = 0.5 * step

    def slope(at: Motion) -> tuple[Vec3, Vec3]:
        wrench = wrench_at(at)
        return (
            acceleration(body, at.attitude, wrench.force, gravity=gravity),
            angular_acceleration(body, at.body_rate, wrench.moment),
        )

    pull, turn = slope(motion)
    middle = Motion(
        position=motion.position + motion.velocity * half,
        velocity=motion.velocity + pull * half,
        attitude=motion.attitude.advanced(motion.attitude, motion.body_rate, half),
        body_rate=motion.body_rate + turn * half,
    )
    pull, turn = slope(middle)
    velocity = motion.velocity + pull * step
    return Motion(
        position=motion.position + (motion.velocity + velocity) * half,
        velocity=velocity,
        attitude=motion.attitude.advanced(middle.attitude, middle.body_rate, step),
        body_rate=motion.body_rate + turn * step,
    )

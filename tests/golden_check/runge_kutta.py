"""The golden flights' integrator, of fourth order: what the others are measured against."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from sim_jax.constants import GRAVITY
from sim_jax.numeric import Scalar
from sim_jax.rigid_body import Motion, WrenchAt, acceleration, angular_acceleration
from sim_jax.vehicle import Body


def step_rk4(
    body: Body, motion: Motion, wrench_at: WrenchAt, step: float, *, gravity: float = GRAVITY
) -> Motion:
    """Advance by the classical Runge-Kutta step: four evaluations, fourth order.

    ``step`` in s, ``gravity`` in m/s².
    """

    def slope(at: Motion) -> Motion:
        wrench = wrench_at(at)
        return Motion(
            position=at.velocity,
            velocity=acceleration(body, at.attitude, wrench.force, gravity=gravity),
            attitude=at.attitude.times_vector(at.body_rate * 0.5),
            body_rate=angular_acceleration(body, at.body_rate, wrench.moment),
        )

    def stage(
        so_far: tuple[Motion, Motion], numbers: tuple[Scalar, Scalar]
    ) -> tuple[tuple[Motion, Motion], None]:
        last, change = so_far
        reach, weight = numbers
        here = slope(jax.tree.map(lambda at, rate: at + rate * reach, motion, last))
        return (here, jax.tree.map(lambda sum_, rate: sum_ + rate * weight, change, here)), None

    still = jax.tree.map(jnp.zeros_like, motion)
    dtype = motion.position.x.dtype
    reaches = jnp.asarray([0.0, 0.5, 0.5, 1.0], dtype) * step
    weights = jnp.asarray([1.0, 2.0, 2.0, 1.0], dtype) * (step / 6.0)
    (_, change), _ = jax.lax.scan(stage, (still, still), (reaches, weights))
    after: Motion = jax.tree.map(jnp.add, motion, change)
    return Motion(after.position, after.velocity, after.attitude.normalized(), after.body_rate)

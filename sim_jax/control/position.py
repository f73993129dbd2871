"""Geometric position control: reference and estimate to wanted acceleration and attitude."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp

from sim_jax.control.gains import AttitudeGains, PositionGains
from sim_jax.numeric import Scalar, safe_divide, saturate
from sim_jax.rotation import Matrix3, Quaternion
from sim_jax.vector import Vec3

CONTROLLER_GRAVITY = 9.8
"""m/s²: the controller's own value, not the plant's 9.81."""


class ReferencePoint(eqx.Module):
    """One tick of the published reference: m, m/s, m/s², world ENU."""

    position: Vec3
    velocity: Vec3
    acceleration: Vec3


def _unit(vector: Vec3) -> Vec3:
    length = vector.norm()
    return Vec3(
        safe_divide(vector.x, length),
        safe_divide(vector.y, length),
        safe_divide(vector.z, length),
    )


def attitude_from_acceleration(acceleration: Vec3, heading: Vec3) -> Quaternion:
    """Return the attitude whose z axis lies along an acceleration and whose x axis is near heading.

    Parameters
    ----------
    acceleration
        Wanted specific force, world, any length.
    heading
        World vector (cos ψ, sin ψ, 0).
    """
    z_axis = _unit(acceleration)
    y_axis = _unit(z_axis.cross(heading))
    x_axis = _unit(y_axis.cross(z_axis))
    return Quaternion.from_matrix(Matrix3(x_axis, y_axis, z_axis))


def feedback_acceleration(
    gains: PositionGains, reference: ReferencePoint, position: Vec3, velocity: Vec3
) -> Vec3:
    """Return -Kp(p - p_ref) - Kv(v - v_ref), scaled back to its limit, in m/s², world."""
    wanted = gains.kp.scaled_by(reference.position - position) + gains.kv.scaled_by(
        reference.velocity - velocity
    )
    length = wanted.norm()
    limit = gains.max_feedback_acceleration
    too_long = length > limit
    return wanted * jnp.where(too_long, limit / jnp.where(too_long, length, 1.0), 1.0)


def heading_of(gains: PositionGains, velocity: Vec3) -> Vec3:
    """Return the heading (cos ψ, sin ψ, 0): ψ = 0, or along the velocity in that mode."""
    one, zero = jnp.ones_like(velocity.x), jnp.zeros_like(velocity.x)
    if not gains.velocity_yaw:
        return Vec3(one, zero, zero)
    speed = Vec3(velocity.x, velocity.y, zero).norm()
    moving = speed > 0
    return Vec3(
        jnp.where(moving, safe_divide(velocity.x, speed), one), safe_divide(velocity.y, speed), zero
    )


def wanted_acceleration(
    gains: PositionGains, reference: ReferencePoint, position: Vec3, velocity: Vec3
) -> Vec3:
    """Return a_fb + a_ref - R_ref D R_refᵀ v_ref + (0, 0, 9.8) in m/s², world.

    Parameters
    ----------
    gains
        Position gains.
    reference
        Where the vehicle should be.
    position, velocity
        Where the controller believes it is: m, m/s, world.
    """
    up = Vec3.zeros(position.x) + Vec3(0.0, 0.0, CONTROLLER_GRAVITY)  # type: ignore[arg-type]
    along_reference = attitude_from_acceleration(
        reference.acceleration + up, heading_of(gains, velocity)
    ).matrix()
    drag = along_reference.to_world(
        gains.reference_drag.scaled_by(along_reference.to_body(reference.velocity))
    )
    feedback = feedback_acceleration(gains, reference, position, velocity)
    return feedback + reference.acceleration - drag + up


def thrust_setpoint(gains: AttitudeGains, acceleration: Vec3, attitude: Quaternion) -> Scalar:
    """Return clip(normalized_constant·a·z_body + normalized_offset, 0, 1)."""
    along = acceleration.dot(attitude.z_axis())
    return saturate(gains.normalized_constant * along + gains.normalized_offset, 0.0, 1.0)

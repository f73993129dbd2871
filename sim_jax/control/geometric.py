"""Geometric control: from reference and estimate to acceleration, attitude, rates and thrust."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp

from sim_jax.control.gains import AttitudeGains, PositionGains
from sim_jax.geometry import Quaternion, Vec3
from sim_jax.numeric import Scalar, safe_divide, safe_sqrt, saturate, where

CONTROLLER_GRAVITY = 9.8
"""m/s²: the controller's own value, not the plant's 9.81."""


class ReferencePoint(eqx.Module):
    """One tick of the published reference: m, m/s, m/s², world ENU."""

    position: Vec3
    velocity: Vec3
    acceleration: Vec3


def _direction(vector: Vec3, otherwise: Vec3 | None = None) -> Vec3:
    """Return the direction of a vector; another one, or upward, where it has none."""
    length = vector.norm()
    has = length > 0
    scale = 1.0 / jnp.where(has, length, 1.0)
    return where(has, vector * scale, otherwise or Vec3.upward(vector.z))


def attitude_from_acceleration(acceleration: Vec3, heading: Vec3) -> Quaternion:
    """Return the attitude of which z lies along an acceleration and x is near a heading.

    Up to the sign of all four numbers: a turn to the heading, then a roll about x and a pitch about
    y that bring z where it belongs, the product of three quaternions with one axis each, which
    spares a matrix and its branches.

    Parameters
    ----------
    acceleration
        Wanted specific force, world, any length.
    heading
        World vector (cos ψ, sin ψ, 0).

    Where there is no acceleration the attitude is upright; where it lies along the heading, the y
    axis stays level, left of the heading. (The original gives not-a-number in both.)
    """
    z_axis = _direction(acceleration)
    ahead = heading.x * z_axis.x + heading.y * z_axis.y
    left = heading.x * z_axis.y - heading.y * z_axis.x
    level = safe_sqrt(left * left + z_axis.z * z_axis.z)
    rolls = level > 0
    scale = 1.0 / jnp.where(rolls, level, 1.0)
    cosine = jnp.where(rolls, z_axis.z * scale, 1.0)
    roll_cos, roll_sin = _half_angle(cosine, -left * scale)
    pitch_cos, pitch_sin = _half_angle(level, ahead)
    yaw_cos, yaw_sin = _half_angle(heading.x, heading.y)
    tilt = Quaternion(
        roll_cos * pitch_cos, roll_sin * pitch_cos, roll_cos * pitch_sin, roll_sin * pitch_sin
    )
    return Quaternion(
        yaw_cos * tilt.w - yaw_sin * tilt.z,
        yaw_cos * tilt.x - yaw_sin * tilt.y,
        yaw_cos * tilt.y + yaw_sin * tilt.x,
        yaw_cos * tilt.z + yaw_sin * tilt.w,
    )


def _half_angle(cosine: Scalar, sine: Scalar) -> tuple[Scalar, Scalar]:
    """Return cosine and sine of half an angle, up to half a turn, from those of the whole.

    The larger number by a root, the other by division.
    """
    ahead = cosine >= 0
    larger = jnp.sqrt(0.5 + 0.5 * jnp.where(ahead, cosine, -cosine))
    other = 0.5 * sine / larger
    return jnp.where(ahead, larger, other), jnp.where(ahead, other, larger)


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
    ones, zeros = jnp.ones_like(velocity.x), jnp.zeros_like(velocity.x)
    if not gains.velocity_yaw:
        return Vec3(ones, zeros, zeros)
    speed = Vec3(velocity.x, velocity.y, zeros).norm()
    moving = speed > 0
    return Vec3(
        jnp.where(moving, safe_divide(velocity.x, speed), ones),
        safe_divide(velocity.y, speed),
        zeros,
    )


def acceleration_setpoint(
    gains: PositionGains, reference: ReferencePoint, position: Vec3, velocity: Vec3, heading: Vec3
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
    heading
        World vector (cos ψ, sin ψ, 0), which turns the axes of the reference's drag.
    """
    up = Vec3.upward(position.z, CONTROLLER_GRAVITY)
    feedback = feedback_acceleration(gains, reference, position, velocity)
    return feedback + reference.acceleration - _reference_drag(gains, reference, up, heading) + up


def _reference_drag(
    gains: PositionGains, reference: ReferencePoint, up: Vec3, heading: Vec3
) -> Vec3:
    """Return R_ref D R_refᵀ v_ref, by the axes that make `attitude_from_acceleration`'s attitude.

    Its quaternion would take three roots more.
    """
    z_axis = _direction(reference.acceleration + up)
    y_axis = _direction(z_axis.cross(heading), Vec3(-heading.y, heading.x, heading.z))
    x_axis, along = y_axis.cross(z_axis), gains.reference_drag

    def part(axis: Vec3, factor: Scalar) -> Vec3:
        return axis * (axis.dot(reference.velocity) * factor)

    return part(x_axis, along.x) + part(y_axis, along.y) + part(z_axis, along.z)


def thrust_setpoint(gains: AttitudeGains, acceleration: Vec3, attitude: Quaternion) -> Scalar:
    """Return clip(normalized_constant·a·z_body + normalized_offset, 0, 1)."""
    along = acceleration.dot(attitude.z_axis())
    return saturate(gains.normalized_constant * along + gains.normalized_offset, 0.0, 1.0)


def quaternion_law(attitude: Quaternion, wanted: Quaternion, time_constant: Scalar) -> Vec3:
    """Return (2/τ)·sgn(q_e,w)·(q_e,x, q_e,y, q_e,z), q_e = q⁻¹ ⊗ q_des (Brescianini)."""
    error = attitude.conjugate().product(wanted)
    gain = jnp.where(error.w < 0, -2.0, 2.0) / time_constant
    return Vec3(gain * error.x, gain * error.y, gain * error.z)


def rotation_matrix_law(attitude: Quaternion, wanted: Quaternion, time_constant: Scalar) -> Vec3:
    """Return (2/τ)·½(RᵀR_des - R_desᵀR)ˇ (Lee), twice as stiff as the other law near zero.

    The vee of the antisymmetric part of RᵀR_des is 2 q_e,w (q_e,x, q_e,y, q_e,z), the same product
    without building the matrices.
    """
    error = attitude.conjugate().product(wanted)
    gain = 4.0 * error.w / time_constant
    return Vec3(gain * error.x, gain * error.y, gain * error.z)


def rate_setpoint(gains: AttitudeGains, attitude: Quaternion, wanted: Quaternion) -> Vec3:
    """Return the body-rate set-point in rad/s, FLU, by the law that is set."""
    law = quaternion_law if gains.law == "quaternion" else rotation_matrix_law
    return law(attitude, wanted, gains.time_constant)

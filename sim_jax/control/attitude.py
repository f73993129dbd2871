"""Attitude control: error between two attitudes to a body-rate set-point."""

from __future__ import annotations

import jax.numpy as jnp

from sim_jax.control.gains import AttitudeGains
from sim_jax.geometry import Quaternion, Vec3
from sim_jax.numeric import Scalar


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

"""The controllers' gains, laws and filters as one pytree; what decides structure is static."""

from __future__ import annotations

from typing import Literal

import equinox as eqx
import jax.numpy as jnp

from sim_jax.geometry import Vec3
from sim_jax.numeric import Scalar
from sim_jax.vehicle import Vehicle


class PositionGains(eqx.Module):
    """Geometric position controller of mavros_controllers."""

    kp: Vec3
    """1/s², acceleration per position error, world axes."""
    kv: Vec3
    """1/s, acceleration per velocity error, world axes."""
    max_feedback_acceleration: Scalar
    """m/s², length at which the feedback is cut."""
    reference_drag: Vec3
    """1/s, diagonal of D in the reference's body axes."""
    velocity_yaw: bool = eqx.field(static=True, default=False)
    """Take the heading from the velocity instead of zero."""


class AttitudeGains(eqx.Module):
    """Attitude law and thrust map of mavros_controllers."""

    time_constant: Scalar
    """s."""
    normalized_constant: Scalar
    """Thrust set-point per m/s² of wanted specific force."""
    normalized_offset: Scalar
    """Thrust set-point at zero specific force."""
    law: Literal["quaternion", "rotation_matrix"] = eqx.field(static=True, default="quaternion")


class RateGains(eqx.Module):
    """PX4 rate controller; axes roll, pitch, yaw. K multiplies P, I and D."""

    p: Vec3
    i: Vec3
    d: Vec3
    ff: Vec3
    k: Vec3
    integrator_limit: Vec3
    saturation_feedback: Scalar
    """1: the mixer desaturates, and stops the integral then, as in PX4; 0: each rotor is clipped by
    itself, and nothing hears of it."""


class Filters(eqx.Module):
    """Low-passes between gyro and rate controller; None leaves one out."""

    gyro_cutoff: Scalar | None
    """Hz, two-pole Butterworth on the rate (IMU_GYRO_CUTOFF)."""
    dgyro_cutoff: Scalar | None
    """Hz, one pole on its derivative (IMU_DGYRO_CUTOFF)."""


class MixerSettings(eqx.Module):
    """PX4 quad-X mixer."""

    airmode: Literal[0, 1, 2] = eqx.field(static=True, default=0)
    thrust_factor: float = eqx.field(static=True, default=0.0)
    """THR_MDL_FAC: 0 linear, 1 thrust proportional to the squared command."""
    pwm_quantisation: bool = eqx.field(static=True, default=False)
    """Truncate commands to whole PWM microseconds, as PX4's output does."""


class Controller(eqx.Module):
    """Everything between a reference and the motor commands."""

    position: PositionGains
    attitude: AttitudeGains
    rate: RateGains
    filters: Filters
    mixer: MixerSettings
    sees_markers: Scalar = eqx.field(default_factory=lambda: jnp.zeros(()))
    """1: position and attitude control see the motion capture's frame; 0: the centre of mass."""


def with_gains_of(controller: Controller, vehicle: Vehicle) -> Controller:
    """Return the controller that flies a vehicle whose effects say how it differs from its file.

    K of the rates is times ``rate_gain_roll_pitch`` and ``rate_gain_yaw``, I times
    ``integral_gain``, the attitude's gain times ``attitude_gain``, the cut-offs of the gyro's
    filter and of its derivative's times ``gyro_cutoff_factor`` and ``derivative_cutoff_factor``:
    parameters that were changed since, or scaled by an autotune or by the battery (PX4
    MC_BAT_SCALE_EN).
    """
    names = (
        "rate_gain_roll_pitch",
        "rate_gain_yaw",
        "integral_gain",
        "attitude_gain",
        "gyro_cutoff_factor",
        "derivative_cutoff_factor",
    )
    if not vehicle.effects.keys() & set(names):
        return controller
    across, about, integral, turning, *filtered = (vehicle.effects.get(n, 1.0) for n in names)
    rate, filters = controller.rate, controller.filters
    cutoffs = (
        None if cutoff is None else cutoff * factor
        for cutoff, factor in zip(
            (filters.gyro_cutoff, filters.dgyro_cutoff), filtered, strict=True
        )
    )
    changed: Controller = eqx.tree_at(
        lambda c: (c.attitude.time_constant, c.rate.k, c.rate.i, c.filters),
        controller,
        (
            controller.attitude.time_constant / turning,
            Vec3(rate.k.x * across, rate.k.y * across, rate.k.z * about),
            rate.i * integral,
            Filters(*cutoffs),
        ),
    )
    return changed

"""PX4's body-rate PID with its integrator rules; axes FRD, torque normalised."""

from __future__ import annotations

from math import radians

import equinox as eqx
import jax.numpy as jnp

from sim_jax.control.gains import RateGains
from sim_jax.geometry import Vec3
from sim_jax.numeric import Flag, Scalar, saturate

INTEGRAL_FADE = radians(400.0)
"""rad/s of rate error at which the integral stops (PX4 RateControl)."""


class Saturation(eqx.Module):
    """Directions of torque that the mixer reports as saturated, per axis."""

    positive: tuple[Flag, Flag, Flag]
    negative: tuple[Flag, Flag, Flag]


def torque_setpoint(
    gains: RateGains, *, rate: Vec3, setpoint: Vec3, acceleration: Vec3, integral: Vec3
) -> Vec3:
    """Return K·(P e - D α) + integral + FF·ω_sp, with the integral from before its update.

    Parameters
    ----------
    gains
        Gains per axis.
    rate, setpoint
        Filtered rate and its set-point, rad/s, FRD.
    acceleration
        Measured angular acceleration, rad/s², FRD.
    integral
        State of the integrator, FRD.
    """
    error = setpoint - rate
    return (
        gains.k.scaled_by(gains.p.scaled_by(error) - gains.d.scaled_by(acceleration))
        + integral
        + gains.ff.scaled_by(setpoint)
    )


def _integrate(
    error: Scalar,
    integral: Scalar,
    *,
    gain: Scalar,
    limit: Scalar,
    positive: Flag,
    negative: Flag,
    feedback: Scalar,
    step: Scalar | float,
) -> Scalar:
    stopped = (positive & (error > 0)) | (negative & (error < 0))
    error = jnp.where(stopped, (1.0 - feedback) * error, error)
    share = error / INTEGRAL_FADE
    fade = 1.0 - share * share
    fade = jnp.where(fade < 0, 0.0, fade)
    return saturate(integral + fade * gain * error * step, -limit, limit)


def next_integral(
    gains: RateGains,
    *,
    rate: Vec3,
    setpoint: Vec3,
    integral: Vec3,
    saturation: Saturation,
    step: Scalar | float,
) -> Vec3:
    """Return the integrator after one step of ``step`` seconds.

    The error counts less the larger it is, nothing above 400°/s, and not at all in a direction in
    which the mixer reports saturation (unless that feedback is off); the state is clamped to
    ±integrator_limit.
    """
    error = setpoint - rate
    gain = gains.k.scaled_by(gains.i)
    axes = zip(
        (error.x, error.y, error.z),
        (integral.x, integral.y, integral.z),
        (gain.x, gain.y, gain.z),
        (gains.integrator_limit.x, gains.integrator_limit.y, gains.integrator_limit.z),
        saturation.positive,
        saturation.negative,
        strict=True,
    )
    x, y, z = (
        _integrate(
            e,
            i,
            gain=g,
            limit=m,
            positive=p,
            negative=n,
            feedback=gains.saturation_feedback,
            step=step,
        )
        for e, i, g, m, p, n in axes
    )
    return Vec3(x, y, z)

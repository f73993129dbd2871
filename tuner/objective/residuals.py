"""Simulated minus recorded, in standard deviations, at the recorded stamps."""

from __future__ import annotations

from collections.abc import Mapping

import equinox as eqx
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Float, Int

from sim_jax.crash import Limits
from sim_jax.rollout import rollout
from sim_jax.rotation import Quaternion
from sim_jax.schedule import Schedule
from tuner.model import Model
from tuner.objective.lanes import _CLOCK_OF, Lanes, Measured


class Trace(eqx.Module):
    """What a rollout is compared by, logged at ``schedule.log_rate``.

    Attributes
    ----------
    channels
        Channel -> (samples, columns, F).
    crash_time
        (F,) s, infinite for a lane that flew.
    """

    channels: dict[str, Float[Array, "samples c F"]]
    crash_time: Float[Array, " F"]


def fly(
    model: Model,
    lanes: Lanes,
    schedule: Schedule,
    *,
    samples: int,
    horizon: Int[Array, ""],
    limits: Limits,
) -> Trace:
    """Simulate every lane up to a horizon in samples."""
    flown = rollout(
        model.vehicle,
        model.controller,
        schedule,
        lanes.inlet,
        lanes.start,
        samples=samples,
        horizon=horizon,
        limits=limits,
    )
    motion = flown.log.motion
    every = {
        "position": (motion.position.x, motion.position.y, motion.position.z),
        "attitude": (motion.attitude.w, motion.attitude.x, motion.attitude.y, motion.attitude.z),
        "body_rate": (motion.body_rate.x, motion.body_rate.y, motion.body_rate.z),
        "rotor_speed": flown.log.rotor_speed,
        "command": flown.log.command,
    }
    return Trace(
        {name: jnp.stack(every[name], axis=1) for name in lanes.measured}, flown.crash_time
    )


def residuals(
    trace: Trace,
    lanes: Lanes,
    offsets: Float[Array, "clocks F"],
    *,
    rate: float,
    horizon: Int[Array, ""],
) -> dict[str, Float[Array, "n k F"]]:
    """Return channel -> (simulated - recorded)/σ, zero beyond the horizon.

    Parameters
    ----------
    trace
        The simulation.
    lanes
        The recording.
    offsets
        s by which each clock's stamps are late: a sample stamped t was taken at t - offset.
    rate
        Hz of the trace.
    horizon
        Samples of the trace that were flown.
    """
    found = {}
    for name, measured in lanes.measured.items():
        time = measured.time - offsets[_CLOCK_OF[name]]
        simulated = _at(trace.channels[name], time * rate, hold=name == "command")
        if name == "attitude":
            error = _attitude_error(measured, simulated)
        else:
            error = simulated - measured.values
        flown = measured.time * rate < horizon - 1
        found[name] = error * measured.weight * flown[:, None]
    return found


def _at(
    series: Float[Array, "samples c F"], place: Float[Array, "n F"], *, hold: bool
) -> Float[Array, "n c F"]:
    """Read a series at fractional sample numbers: held, or interpolated linearly."""
    last = series.shape[0] - 2
    below = jnp.clip(jnp.floor(lax.stop_gradient(place) + 1e-6), 0, last).astype(jnp.int32)
    first = jnp.take_along_axis(series, below[:, None], axis=0)
    if hold:
        return first
    second = jnp.take_along_axis(series, below[:, None] + 1, axis=0)
    share = (place - below)[:, None]
    return first + share * (second - first)


def _attitude_error(measured: Measured, simulated: Float[Array, "n 4 F"]) -> Float[Array, "n 3 F"]:
    recorded = Quaternion.of(jnp.moveaxis(measured.values, 1, 0))
    flown = Quaternion.of(jnp.moveaxis(simulated, 1, 0))
    return jnp.moveaxis(recorded.rotation_vector_to(flown).stacked(), 0, 1)


def sum_of_squares(parts: Mapping[str, Array]) -> Array:
    """Return the sum of squares over channels and samples, per lane (F,)."""
    return sum((jnp.sum(part * part, axis=(0, 1)) for part in parts.values()), jnp.zeros(()))

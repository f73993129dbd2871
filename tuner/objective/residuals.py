"""Simulated minus recorded, in standard deviations, at the recorded stamps."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import equinox as eqx
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Float, Int

from sim_jax.crash import Limits
from sim_jax.environment import Environment
from sim_jax.inlet import Inlet
from sim_jax.markers import markers_of
from sim_jax.rigid_body import Motion
from sim_jax.rollout import Rollout, rollout
from sim_jax.rotation import Quaternion
from sim_jax.schedule import Schedule
from sim_jax.state import Start
from sim_jax.terms.air import Air
from sim_jax.terms.total import total_wrench
from sim_jax.trim import in_trim
from sim_jax.vector import Vec3
from sim_jax.vehicle import PerRotor, Vehicle
from tuner.model import Model
from tuner.objective.battery import relative_log_voltage
from tuner.objective.initial_conditions import ROWS, moved, spun_up, trimmed, whole
from tuner.objective.segments import CLOCK_OF, CLOCKS, Measured, Segments

RAMP = 0.25
"""Share of the time between two jumps of a zero-order hold that the ramp to the next takes."""


class Trace(eqx.Module):
    """What a rollout is compared by, logged at ``schedule.log_rate``; its pose is the markers'.

    Attributes
    ----------
    channels
        Channel -> (samples, columns, F).
    crash_time
        (F,) s, infinite for a segment that flew.
    """

    channels: dict[str, Float[Array, "samples c F"]]
    crash_time: Float[Array, " F"]


def trace_of(
    flown: Rollout,
    model: Model,
    segments: Segments,
    conditions: Mapping[str, Float[Array, " F"]] = MappingProxyType({}),
) -> Trace:
    """Return what simulated segments are compared by; ``conditions`` as of `simulate_segments`."""
    motion, markers = flown.log.motion, markers_of(model.vehicle)
    position, attitude = motion.position, motion.attitude
    if markers is not None:
        position, attitude = markers.recorded(motion)
    logged = {
        "position": (position.x, position.y, position.z),
        "attitude": (attitude.w, attitude.x, attitude.y, attitude.z),
        "body_rate": (motion.body_rate.x, motion.body_rate.y, motion.body_rate.z),
        "rotor_speed": flown.log.rotor_speed,
        "command": flown.log.command,
    }
    if "acceleration" in segments.measured:
        environment = environment_of(model, segments, conditions)
        logged["acceleration"] = accelerometer(
            model.vehicle, motion, flown.log.rotor_speed, environment, conditions
        )
    return Trace(
        {name: jnp.stack(logged[name], axis=1) for name in segments.measured}, flown.crash_time
    )


def simulate_segments(
    model: Model,
    segments: Segments,
    schedule: Schedule,
    *,
    samples: int,
    horizon: Int[Array, ""] | None,
    limits: Limits,
    states: Float[Array, "L F"] | None = None,
    conditions: Mapping[str, Float[Array, " F"]] = MappingProxyType({}),
) -> Rollout:
    """Simulate every segment up to a horizon in samples.

    Parameters
    ----------
    model, segments, schedule, samples, horizon, limits
        As of `sim_jax.rollout.rollout`.
    states
        How far the starts lie from the recorded ones, in the segments' standard deviations.
    conditions
        Name, of `tuner.coefficients.conditions` -> what surrounds each segment, in its unit.
    """
    start, inlet, environment = beginning_of(
        model, segments, schedule, states=states, conditions=conditions
    )
    return rollout(
        model.vehicle,
        model.controller,
        schedule,
        inlet,
        start,
        samples=samples,
        environment=environment,
        horizon=horizon,
        limits=limits,
    )


def beginning_of(
    model: Model,
    segments: Segments,
    schedule: Schedule,
    *,
    states: Float[Array, "L F"] | None = None,
    conditions: Mapping[str, Float[Array, " F"]] = MappingProxyType({}),
) -> tuple[Start, Inlet, Environment]:
    """Return what segments start from, what is fed in and what surrounds them.

    The arguments are those of `simulate_segments`.
    """
    start, inlet = segments.start, segments.inlet
    markers = markers_of(model.vehicle)
    if markers is not None:
        start = markers.start(start, segments.resting, model.controller.sees_markers)
    environment = environment_of(model, segments, conditions)
    if segments.resting is not None:
        exponent = model.vehicle.effects.get("battery_exponent")
        factor = environment.speed_factor(exponent, jnp.asarray(0), schedule)
        start = in_trim(
            model.vehicle, model.controller, start, segments.resting, speed_factor=factor
        )
    if segments.wander is not None:
        start = moved(start, segments.wander)
    if segments.turning is not None:
        start = spun_up(start, model.vehicle, segments.turning)
    if states is not None and segments.freedom is not None:
        change = whole(states * segments.freedom, segments.freed)
        start = moved(start, change)
        if ROWS["trim"].start in segments.freed:
            inlet = trimmed(inlet, model.vehicle, change)
    return start, inlet, environment


def accelerometer(
    vehicle: Vehicle,
    motion: Motion,
    rotor_speed: PerRotor,
    environment: Environment,
    biases: Mapping[str, Float[Array, " F"]],
) -> tuple[Array, Array, Array]:
    """Return what an accelerometer at the centre of mass reads, m/s² along the body's axes.

    That is the specific force: all that acts but gravity, over the mass; plus its bias.
    """
    air = Air.around(vehicle, motion, environment, tuple(jnp.zeros_like(w) for w in rotor_speed))
    pull = total_wrench(vehicle, motion, rotor_speed, air).force * (1.0 / vehicle.body.mass)
    x, y, z = (getattr(pull, axis) + biases.get(f"accelerometer_{axis}", 0.0) for axis in "xyz")
    return x, y, z


def environment_of(
    model: Model, segments: Segments, conditions: Mapping[str, Float[Array, " F"]]
) -> Environment:
    """Return what surrounds the segments, as far as it acts on a model."""
    log_voltage = None
    volts, reference = segments.log_voltage, model.reference_voltage
    acts = "battery_exponent" in model.vehicle.effects
    if acts and volts is not None and reference is not None:
        log_voltage = relative_log_voltage(volts, reference)
    decline = conditions.get("battery_decline")
    return Environment(
        wind=_wind(conditions),
        log_voltage=log_voltage,
        battery_decline=decline,
        begin=None if decline is None else segments.begin,
    )


def _wind(conditions: Mapping[str, Float[Array, " F"]]) -> Vec3 | None:
    known = [conditions[name] for name in ("wind_x", "wind_y") if name in conditions]
    if not known:
        return None
    calm = jnp.zeros_like(known[0])
    return Vec3(conditions.get("wind_x", calm), conditions.get("wind_y", calm), calm)


def residuals(
    trace: Trace,
    segments: Segments,
    offsets: Float[Array, "offsets F"],
    reference_offset: Float[Array, "clocks F"],
    *,
    rate: float,
    horizon: Int[Array, ""],
) -> dict[str, Float[Array, "n k F"]]:
    """Return channel -> (simulated - recorded)/σ, zero beyond the horizon.

    Parameters
    ----------
    trace, offsets, reference_offset, rate
        As of `simulated_at_stamps`.
    segments
        The recording.
    horizon
        Samples of the trace that were flown.
    """
    weighted = {}
    for name, measured in segments.measured.items():
        simulated = simulated_at_stamps(trace, name, measured, offsets, reference_offset, rate=rate)
        flown = measured.time * rate < horizon - 1
        if name == "attitude":
            error = _attitude_error(measured, simulated)
        else:
            error = simulated - measured.values
        weighted[name] = error * measured.weight * flown[:, None]
    return weighted


def simulated_at_stamps(
    trace: Trace,
    channel: str,
    measured: Measured,
    offsets: Float[Array, "offsets F"],
    reference_offset: Float[Array, "clocks F"],
    *,
    rate: float,
) -> Float[Array, "n c F"]:
    """Return what a recording of the simulation would hold at the recorded stamps.

    Parameters
    ----------
    trace
        The simulation.
    channel
        Which signal.
    measured
        Its recorded samples.
    offsets
        s by which each clock's stamps are late: a sample stamped t was taken at t - offset; then
        rad/s by which the gyro reads too much about each axis.
    reference_offset
        s of clock offset at which signals that jump between samples are read exactly; from there to
        ``offsets`` they move smoothly, for a loss that jumps cannot be minimised.
    rate
        Hz of the trace.
    """
    clock = CLOCK_OF[channel]
    place = (measured.time - offsets[clock]) * rate
    if channel == "command":
        before = (measured.time - reference_offset[clock]) * rate
        return _zero_order_hold_moved(trace.channels[channel], before, place)
    simulated = _linear_interpolation(trace.channels[channel], place)
    return simulated + offsets[len(CLOCKS) :] if channel == "body_rate" else simulated


def _below(series: Array, place: Float[Array, "n F"]) -> Int[Array, "n 1 F"]:
    last = series.shape[0] - 2
    below = jnp.floor(lax.stop_gradient(place) + 1e-6).astype(jnp.int32)
    return jnp.clip(below, 0, last)[:, None]


def _linear_interpolation(
    series: Float[Array, "samples c F"], place: Float[Array, "n F"]
) -> Float[Array, "n c F"]:
    """Read a series at fractional sample numbers by linear interpolation."""
    first, second, share = _around(series, place)
    return first + share * (second - first)


def _around(series: Float[Array, "samples c F"], place: Float[Array, "n F"]) -> tuple[Array, ...]:
    """Return the samples (n, c, F) before and after places, and the share (n, 1, F) between."""
    below = _below(series, place)
    first = jnp.take_along_axis(series, below, axis=0)
    second = jnp.take_along_axis(series, below + 1, axis=0)
    return first, second, place[:, None] - below


def _zero_order_hold_moved(
    series: Float[Array, "samples c F"], before: Float[Array, "n F"], place: Float[Array, "n F"]
) -> Float[Array, "n c F"]:
    """Read a zero-order hold, moved a little along a ramp into each of its next values.

    A sample whose stamp falls well between two jumps does not move: samples that were taken in
    step with the jumps say nothing of a clock but where it passes one. Those of any other times
    are on a ramp so often that their mean moves as the signal does.
    """
    step = jnp.take_along_axis(series, _below(series, before), axis=0)
    return step + _ramps(series, place) - _ramps(series, before)


def _ramps(
    series: Float[Array, "samples c F"], place: Float[Array, "n F"]
) -> Float[Array, "n c F"]:
    first, second, share = _around(series, place)
    risen = jnp.clip(1.0 - (1.0 - share) / RAMP, 0.0, 1.0)
    return first + risen * (second - first)


def _attitude_error(measured: Measured, simulated: Float[Array, "n 4 F"]) -> Float[Array, "n 3 F"]:
    recorded = Quaternion.of(jnp.moveaxis(measured.values, 1, 0))
    flown = Quaternion.of(jnp.moveaxis(simulated, 1, 0))
    return jnp.moveaxis(recorded.rotation_vector_to(flown).stacked(), 0, 1)

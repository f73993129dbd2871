"""Segments as flights in JAX: their starts, what is fed in, and what is recorded of them."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from types import MappingProxyType

import jax.numpy as jnp
from jaxtyping import Float

from sim_jax.environment import Air, Environment
from sim_jax.frames import gyro_of, markers_of
from sim_jax.geometry import Vec3
from sim_jax.inlet import Inlet
from sim_jax.numeric import Array
from sim_jax.plant import Sample
from sim_jax.rigid_body import Motion
from sim_jax.schedule import Schedule
from sim_jax.state import Start
from sim_jax.terms.total import total_wrench
from sim_jax.trim import in_trim
from sim_jax.vehicle import PerRotor, Vehicle
from tuner.objective.battery import relative_log_voltage
from tuner.objective.initial_conditions import ROWS, moved, spun_up, trimmed, whole
from tuner.objective.segments import Segments
from tuner.vehicle.model import Model

MOTION, TURNED, SPEEDS, SETPOINTS = "motion", "turned", "speeds", "setpoints"
"""What no recording holds: the centre of mass's position, velocity and body rate; the body's
attitude; the rotors' speeds; and the set-points of rate and thrust."""


def recorded_of(
    log: Sample,
    model: Model,
    environment: Environment,
    conditions: Mapping[str, Float[Array, " *F"]],
    channels: Collection[str],
) -> dict[str, Array]:
    """Return channel -> what a recording of logged samples would hold, columns after the samples.

    Parameters
    ----------
    log
        Leaves (*samples, *F), or those of one sample.
    model, environment, conditions
        As they were flown.
    channels
        Which are asked for.
    """
    motion = log.motion
    position, attitude = markers_of(model.vehicle).recorded(motion)
    rate = gyro_of(model.vehicle).reading(motion.body_rate)
    logged = {
        "position": (position.x, position.y, position.z),
        "attitude": (attitude.w, attitude.x, attitude.y, attitude.z),
        "body_rate": _parts(rate),
        "rotor_speed": log.rotor_speed if log.read_speed is None else log.read_speed,
        "command": log.command,
        MOTION: (*_parts(motion.position), *_parts(motion.velocity), *_parts(motion.body_rate)),
        SPEEDS: log.rotor_speed,
        TURNED: tuple(getattr(motion.attitude, axis) for axis in "wxyz"),
        SETPOINTS: (*_parts(log.setpoints.rate), log.setpoints.thrust),
    }
    if "acceleration" in channels:
        logged["acceleration"] = accelerometer(
            model.vehicle, motion, log.rotor_speed, environment, conditions
        )
    axis = min(jnp.ndim(position.x), 1)
    return {name: jnp.stack(logged[name], axis=axis) for name in channels}


def _parts(vector: Vec3) -> tuple[Array, Array, Array]:
    return vector.x, vector.y, vector.z


def beginning_of(
    model: Model,
    segments: Segments,
    schedule: Schedule,
    *,
    states: Float[Array, "L F"] | None = None,
    conditions: Mapping[str, Float[Array, " F"]] = MappingProxyType({}),
) -> tuple[Start, Inlet, Environment]:
    """Return what segments start from, what is fed in and what surrounds them.

    Parameters
    ----------
    model, segments, schedule
        What flies.
    states
        How far the starts lie from the recorded ones, in the segments' standard deviations.
    conditions
        Name, of `tuner.vehicle.conditions` -> what surrounds each segment, in its unit.
    """
    start, inlet = segments.start, segments.inlet
    true = gyro_of(model.vehicle).body_rate(start.motion.body_rate)
    start = replace(start, motion=replace(start.motion, body_rate=true))
    start = markers_of(model.vehicle).start(start, segments.resting, model.controller.sees_markers)
    environment = environment_of(model, segments, conditions)
    exponent = model.vehicle.effects.get("battery_exponent")
    factor = environment.speed_factor(exponent, jnp.asarray(0), schedule)
    if segments.resting is not None:
        start = in_trim(
            model.vehicle, model.controller, start, segments.resting, speed_factor=factor
        )
    if segments.wander is not None:
        start = moved(start, segments.wander)
    if segments.turning is not None:
        start = spun_up(start, model.vehicle, segments.turning, speed_factor=factor)
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
        disturbance=segments.disturbance,
    )


def _wind(conditions: Mapping[str, Float[Array, " F"]]) -> Vec3 | None:
    known = [conditions[name] for name in ("wind_x", "wind_y") if name in conditions]
    if not known:
        return None
    calm = jnp.zeros_like(known[0])
    return Vec3(conditions.get("wind_x", calm), conditions.get("wind_y", calm), calm)

"""Vehicle and controller files as the values that the simulator flies."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from sim_jax.control.gains import (
    AttitudeGains,
    Controller,
    Filters,
    MixerSettings,
    PositionGains,
    RateGains,
)
from sim_jax.geometry import Vec3
from sim_jax.numeric import Scalar
from sim_jax.schedule import Schedule
from sim_jax.vehicle import Aerodynamics, Body, Motor, Rotor, Setup, Vehicle
from tuner.vehicle import COEFFICIENTS, Coefficient, ControllerFile, VehicleFile, initial_values
from tuner.vehicle.vehicle import check_filter, max_latency, size_of

REFERENCE_ROTOR_RADIUS = 0.13
"""m, for a vehicle of the registry's size; that of others scales with the arm."""
NON_NUMERIC_KEYS = ("reaction_torque", "thrust_law")
"""Keys of the vehicle file's aerodynamics that are no number."""


class Model(eqx.Module):
    """A vehicle with the controllers that fly it."""

    vehicle: Vehicle
    controller: Controller
    reference_voltage: Scalar | None = None
    """V of the battery at which the motors reach their reference speeds; None where unknown."""


def coefficients_in(model: Model) -> dict[str, Scalar]:
    """Return name -> coefficients of a model, without absent ones, always in one order."""
    leaves = {name: _leaf(model, coefficient) for name, coefficient in COEFFICIENTS.items()}
    return {name: value for name, value in leaves.items() if value is not None}


def _leaf(model: Model, coefficient: Coefficient) -> Scalar | None:
    if coefficient.is_effect:
        return model.vehicle.effects.get(coefficient.name)
    node: Any = model
    for attribute in coefficient.leaf_path:
        node = getattr(node, attribute)
    leaf: Scalar | None = node
    return leaf


def with_coefficients(model: Model, values: Mapping[str, Scalar]) -> Model:
    """Return the model with coefficients replaced; values broadcast over the batch.

    A coefficient of a term that the model leaves out brings the term in.

    Raises
    ------
    KeyError
        A name is no coefficient's.
    """
    rows = [COEFFICIENTS[name] for name in values]
    replaced = [row for row in rows if not row.is_effect]
    changed = model
    if replaced:
        leaves, structure = jax.tree.flatten(model, is_leaf=lambda leaf: leaf is None)
        places = jax.tree.unflatten(structure, range(len(leaves)))
        for row in replaced:
            place: Any = _leaf(places, row)
            leaves[place] = values[row.name]
        changed = jax.tree.unflatten(structure, leaves)
    effects = {row.name: values[row.name] for row in rows if row.is_effect}
    if not effects:
        return changed
    vehicle = changed.vehicle
    return replace(changed, vehicle=replace(vehicle, effects=vehicle.effects | effects))


def with_terms_computed(model: Model, names: Collection[str]) -> Model:
    """Return the model with absent terms added at their neutral values.

    Its flights stay the same; models with and without these terms share their programs.
    """
    given = coefficients_in(model)
    neutral = {name: jnp.asarray(COEFFICIENTS[name].neutral) for name in names if name not in given}
    return with_coefficients(model, neutral)


def vehicle_of(file: VehicleFile) -> Vehicle:
    """Return the simulator's vehicle, without terms at their neutral values."""
    aerodynamics = file.aerodynamics
    return Vehicle(
        body=Body(
            *map(jnp.asarray, (file.mass, file.inertia.xx, file.inertia.yy, file.inertia.zz))
        ),
        rotors=tuple(
            Rotor(_vector(rotor.position), 1 if rotor.spin == "ccw" else -1)
            for rotor in file.rotors
        ),
        motor=Motor(**{key: jnp.asarray(value) for key, value in file.motor}),
        aerodynamics=Aerodynamics(
            **{k: jnp.asarray(v) for k, v in aerodynamics if k not in NON_NUMERIC_KEYS},
            reaction_torque=aerodynamics.reaction_torque,
            thrust_law=aerodynamics.thrust_law,
        ),
        setup=Setup(
            jnp.asarray(file.setup.estimate_latency), jnp.asarray(file.setup.actuator_latency)
        ),
        effects={
            name: jnp.asarray(value)
            for name, value in file.effects.items()
            if value != COEFFICIENTS[name].neutral
        },
        rotor_radius=jnp.asarray(REFERENCE_ROTOR_RADIUS * size_of(file).arm),
    )


def controller_of(file: ControllerFile) -> Controller:
    """Return the simulator's controller."""
    roll, pitch, yaw = file.rate.roll, file.rate.pitch, file.rate.yaw
    limit = file.rate.integrator_limit
    gyro, dgyro = file.filters.gyro_cutoff, file.filters.dgyro_cutoff
    return Controller(
        position=PositionGains(
            kp=_vector(file.position.kp),
            kv=_vector(file.position.kv),
            max_feedback_acceleration=jnp.asarray(file.position.max_feedback_acceleration),
            reference_drag=_vector(file.position.reference_drag),
            velocity_yaw=file.position.velocity_yaw,
        ),
        attitude=AttitudeGains(
            time_constant=jnp.asarray(file.attitude.time_constant),
            normalized_constant=jnp.asarray(file.thrust.normalized_constant),
            normalized_offset=jnp.asarray(file.thrust.normalized_offset),
            law=file.attitude.law,
        ),
        rate=RateGains(
            p=_vector((roll.p, pitch.p, yaw.p)),
            i=_vector((roll.i, pitch.i, yaw.i)),
            d=_vector((roll.d, pitch.d, yaw.d)),
            ff=_vector((roll.ff, pitch.ff, yaw.ff)),
            k=_vector((roll.k, pitch.k, yaw.k)),
            integrator_limit=_vector((limit, limit, limit)),
            saturation_feedback=jnp.asarray(1.0 if file.mixer.saturation_feedback else 0.0),
        ),
        filters=Filters(
            gyro_cutoff=None if gyro is None else jnp.asarray(float(gyro)),
            dgyro_cutoff=None if dgyro is None else jnp.asarray(float(dgyro)),
        ),
        mixer=MixerSettings(
            airmode=file.mixer.airmode,
            thrust_factor=float(file.mixer.thrust_factor),
            pwm_quantisation=file.mixer.pwm_quantisation,
        ),
        sees_markers=jnp.asarray(1.0 if file.sensing.sees_markers else 0.0),
    )


def model_of(vehicle: VehicleFile, controller: ControllerFile) -> Model:
    """Return both files as one value to fly; of what both give, the vehicle file's holds.

    Raises
    ------
    ConfigError
        Their rates do not go together.
    """
    check_filter(vehicle, controller)
    volts = vehicle.battery.reference_voltage
    reference = None if volts is None else jnp.asarray(volts)
    model = Model(vehicle_of(vehicle), controller_of(controller), reference)
    values = initial_values(vehicle, controller)
    shared = {name for name, row in COEFFICIENTS.items() if row.fallback and name in values}
    return with_coefficients(model, {name: jnp.asarray(values[name]) for name in shared})


def schedule_of(file: ControllerFile, *, log_rate: int | None = None) -> Schedule:
    """Return the loop rates of a controller file, with delay lines for a fit's latencies.

    Parameters
    ----------
    file
        Loop rates in Hz, integrator and pose rate.
    log_rate
        Hz of the logged samples; None logs every physics step.
    """
    physics = round(file.physics.rate)
    return Schedule(
        physics_rate=physics,
        rate_control_rate=round(file.rate.rate),
        position_control_rate=round(file.position.rate),
        log_rate=physics if log_rate is None else log_rate,
        integrator=file.physics.integrator,
        pose_rate=file.sensing.pose_rate,
        longest_estimate_latency=max_latency("estimate_latency"),
        longest_actuator_latency=max_latency("actuator_latency"),
    )


def _vector(values: tuple[float, float, float]) -> Vec3:
    x, y, z = (jnp.asarray(float(value)) for value in values)
    return Vec3(x, y, z)

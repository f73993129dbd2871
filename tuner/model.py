"""Vehicle and controller files as the values that the simulator flies."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp

from sim_jax.control.gains import (
    AttitudeGains,
    Controller,
    Filters,
    MixerSettings,
    PositionGains,
    RateGains,
)
from sim_jax.numeric import Scalar
from sim_jax.schedule import Schedule
from sim_jax.vector import Vec3
from sim_jax.vehicle import Aerodynamics, Body, Motor, Rotor, Setup, Vehicle
from tuner.config import ControllerFile, VehicleFile

LONGEST_ESTIMATE_LATENCY = 0.1
"""s; the delay line of a fit reaches this far back, and so does the coefficient's bound."""
LONGEST_ACTUATOR_LATENCY = 0.04
"""s."""


class Model(eqx.Module):
    """A vehicle with the controllers that fly it."""

    vehicle: Vehicle
    controller: Controller


#: Coefficient name -> where it lives in a `Model`.
_PLACES: Mapping[str, tuple[str, ...]] = {
    "mass": ("vehicle", "body", "mass"),
    "inertia_xx": ("vehicle", "body", "inertia_xx"),
    "inertia_yy": ("vehicle", "body", "inertia_yy"),
    "inertia_zz": ("vehicle", "body", "inertia_zz"),
    "input_scaling": ("vehicle", "motor", "input_scaling"),
    "zero_position_armed": ("vehicle", "motor", "zero_position_armed"),
    "input_offset": ("vehicle", "motor", "input_offset"),
    "quadratic": ("vehicle", "motor", "quadratic"),
    "time_constant_up": ("vehicle", "motor", "time_constant_up"),
    "time_constant_down": ("vehicle", "motor", "time_constant_down"),
    "motor_constant": ("vehicle", "aerodynamics", "motor_constant"),
    "moment_constant": ("vehicle", "aerodynamics", "moment_constant"),
    "rotor_drag_coefficient": ("vehicle", "aerodynamics", "rotor_drag_coefficient"),
    "rolling_moment_coefficient": ("vehicle", "aerodynamics", "rolling_moment_coefficient"),
    "max_relative_airspeed": ("vehicle", "aerodynamics", "max_relative_airspeed"),
    "estimate_latency": ("vehicle", "setup", "estimate_latency"),
    "actuator_latency": ("vehicle", "setup", "actuator_latency"),
    "gyro_cutoff": ("controller", "filters", "gyro_cutoff"),
}


def coefficients_in(model: Model) -> dict[str, Scalar]:
    """Return every coefficient that a model has; one that is left out, as a filter may be, is not.

    The order is always the same.
    """
    found = {name: _leaf(model, name) for name in _PLACES}
    return {name: value for name, value in found.items() if value is not None}


def _leaf(model: Model, name: str) -> Scalar | None:
    node: Any = model
    for part in _PLACES[name]:
        node = getattr(node, part)
    leaf: Scalar | None = node
    return leaf


def with_coefficients(model: Model, values: Mapping[str, Scalar]) -> Model:
    """Return the model with coefficients replaced; values broadcast over the batch.

    Raises
    ------
    KeyError
        A name is no coefficient's.
    """
    names = list(values)
    changed: Model = eqx.tree_at(
        lambda tree: [_leaf(tree, name) for name in names],
        model,
        [values[name] for name in names],
        is_leaf=lambda leaf: leaf is None,
    )
    return changed


def vehicle_of(file: VehicleFile) -> Vehicle:
    """Return the simulator's vehicle, float64 where that is switched on."""
    first, second, third, fourth = (
        Rotor(_vector(rotor.position), 1 if rotor.spin == "ccw" else -1) for rotor in file.rotors
    )
    aerodynamics = file.aerodynamics
    return Vehicle(
        body=Body(
            *map(jnp.asarray, (file.mass, file.inertia.xx, file.inertia.yy, file.inertia.zz))
        ),
        rotors=(first, second, third, fourth),
        motor=Motor(
            input_scaling=jnp.asarray(file.motor.input_scaling),
            zero_position_armed=jnp.asarray(file.motor.zero_position_armed),
            max_rotor_velocity=jnp.asarray(file.motor.max_rotor_velocity),
            time_constant_up=jnp.asarray(file.motor.time_constant_up),
            time_constant_down=jnp.asarray(file.motor.time_constant_down),
            input_offset=jnp.asarray(file.motor.input_offset),
            quadratic=jnp.asarray(file.motor.quadratic),
        ),
        aerodynamics=Aerodynamics(
            motor_constant=jnp.asarray(aerodynamics.motor_constant),
            moment_constant=jnp.asarray(aerodynamics.moment_constant),
            rotor_drag_coefficient=jnp.asarray(aerodynamics.rotor_drag_coefficient),
            rolling_moment_coefficient=jnp.asarray(aerodynamics.rolling_moment_coefficient),
            max_relative_airspeed=jnp.asarray(aerodynamics.max_relative_airspeed),
            reaction_torque=aerodynamics.reaction_torque,
        ),
        setup=Setup(
            jnp.asarray(file.setup.estimate_latency), jnp.asarray(file.setup.actuator_latency)
        ),
    )


def controller_of(file: ControllerFile, gyro_cutoff: float | None = None) -> Controller:
    """Return the simulator's controller; a cutoff in Hz given here wins over the file's."""
    roll, pitch, yaw = file.rate.roll, file.rate.pitch, file.rate.yaw
    limit = file.rate.integrator_limit
    cutoff = file.filters.gyro_cutoff if gyro_cutoff is None else gyro_cutoff
    dgyro = file.filters.dgyro_cutoff
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
            gyro_cutoff=None if cutoff is None else jnp.asarray(float(cutoff)),
            dgyro_cutoff=None if dgyro is None else jnp.asarray(float(dgyro)),
        ),
        mixer=MixerSettings(
            airmode=file.mixer.airmode,
            thrust_factor=float(file.mixer.thrust_factor),
            pwm_quantisation=file.mixer.pwm_quantisation,
        ),
    )


def model_of(vehicle: VehicleFile, controller: ControllerFile) -> Model:
    """Return both files as one value to fly."""
    return Model(
        vehicle_of(vehicle), controller_of(controller, gyro_cutoff=vehicle.setup.gyro_cutoff)
    )


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
        longest_estimate_latency=LONGEST_ESTIMATE_LATENCY,
        longest_actuator_latency=LONGEST_ACTUATOR_LATENCY,
    )


def _vector(values: tuple[float, float, float]) -> Vec3:
    x, y, z = (jnp.asarray(float(value)) for value in values)
    return Vec3(x, y, z)

"""The tags that are ours, as the registry of coefficients has them, and their values."""

from __future__ import annotations

import math
from typing import Literal

from tuner.vehicle import COEFFICIENTS, VehicleFile, Written, values_of, with_values

Parent = Literal["inertial", "inertia", "motor", "channel"]

#: A motor plugin's tag that is no coefficient, as flights do not show it -> key of `Motor`.
SPEED_LIMIT, SPEED_LIMIT_KEY = "maxRotVelocity", "max_rotor_velocity"

MOTOR_CONSTANT = "motorConstant"
CENTER_OF_MASS = tuple(f"center_of_mass_{axis}" for axis in "xyz")


def tags_in(parent: Parent) -> dict[str, str]:
    """Return tag -> name of the number that it holds.

    Parameters
    ----------
    parent
        The element that the tags stand in: ``motor`` is a motor model plugin, of Gazebo classic and
        gz-sim alike, ``channel`` a control channel of PX4's interface plugin for Gazebo classic.
    """
    tags = {SPEED_LIMIT: SPEED_LIMIT_KEY} if parent == "motor" else {}
    for name, row in COEFFICIENTS.items():
        entry = row.exported_as.get("sdf")
        if isinstance(entry, Written) and entry.parent == parent:
            tags[entry.tag] = name
    return tags


def numbers_of(vehicle: VehicleFile) -> dict[str, float]:
    """Return name -> value of all that may have a tag."""
    return values_of(vehicle) | {SPEED_LIMIT_KEY: vehicle.motor.max_rotor_velocity}


def values(vehicle: VehicleFile, parent: Parent) -> dict[str, float]:
    """Return tag to value for a vehicle; not those of coefficients that it leaves out."""
    numbers = numbers_of(vehicle)
    return {tag: numbers[name] for tag, name in tags_in(parent).items() if name in numbers}


def center_of_mass(vehicle: VehicleFile) -> tuple[float, ...] | None:
    """Return m from where rotor positions count to the centre of mass; None where they agree."""
    if not any(vehicle.effects.get(name) for name in CENTER_OF_MASS):
        return None
    return tuple(vehicle.effects.get(name, 0.0) for name in CENTER_OF_MASS)


def motor_constants(vehicle: VehicleFile) -> dict[str, float] | None:
    """Return what each rotor's motor constant is called -> its value; None where all are alike.

    The rotors' scales are factors on thrust and torque, whose product is 1: the last one follows.
    """
    count = len(vehicle.rotors)
    scales = [vehicle.effects.get(f"rotor_thrust_scale_{i + 1}") for i in range(count)]
    if all(scale in (None, 1.0) for scale in scales):
        return None
    if scales[-1] is None:
        scales[-1] = 1.0 / math.prod(scale for scale in scales if scale is not None)
    constant = vehicle.aerodynamics.motor_constant
    return {
        of_rotor(i): constant if scale is None else constant * scale
        for i, scale in enumerate(scales)
    }


def of_rotor(index: int) -> str:
    """Return what the motor constant of one rotor among uneven ones is called."""
    return f"motor_constant of rotor_{index}"


def carried_values(vehicle: VehicleFile, *, channels: bool) -> dict[str, float]:
    """Return name -> value of what a model of a vehicle must hold.

    Parameters
    ----------
    channels
        Whether it has control channels, as models for Gazebo classic have.
    """
    carried: set[str] = set()
    for name, row in COEFFICIENTS.items():
        entry = row.exported_as.get("sdf")
        if isinstance(entry, Written) and (channels or entry.parent != "channel"):
            carried.add(name)
    carried.add(SPEED_LIMIT_KEY)
    numbers = {
        name: value
        for name, value in numbers_of(vehicle).items()
        if name in carried and name not in vehicle.effects
    }
    uneven, centre = motor_constants(vehicle), center_of_mass(vehicle)
    if centre is not None:
        numbers |= dict(zip(CENTER_OF_MASS, centre, strict=True))
    if uneven is not None:
        del numbers["motor_constant"]
        numbers |= uneven
    return numbers


def as_text(value: float) -> str:
    """Return a number as it is written into a model: twelve digits at most, no needless ones."""
    return format(value, ".12g")


def as_flown(vehicle: VehicleFile, read: dict[str, float]) -> VehicleFile:
    """Return a vehicle, as its simulator flies it, with the numbers that a model holds.

    Of uneven rotors it holds each one's motor constant, which are the vehicle's own.
    """
    limit = read[SPEED_LIMIT_KEY]
    coefficients = {name: value for name, value in read.items() if name in COEFFICIENTS}
    flown = with_values(vehicle, coefficients)
    return flown.replace(motor=flown.motor.replace(max_rotor_velocity=limit))


def lost_in(vehicle: VehicleFile) -> tuple[str, ...]:
    """Return what of a vehicle, beside coefficients, the plugins fly differently."""
    if vehicle.aerodynamics.reaction_torque == "body":
        return ()
    return ("the plugins' reaction torque acts about the body's z axis, not the world's",)

"""SDF tags of coefficients, from the registry: their values, written and read back."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np

from tuner.core.errors import ExportError
from tuner.core.numerics import Array
from tuner.exporters.sdf.model import Model, composite
from tuner.exporters.sdf.spans import Element
from tuner.vehicle import COEFFICIENTS, VehicleFile, Written, values_of, with_values

Parent = Literal["inertial", "inertia", "motor", "channel"]

#: A motor plugin's tag without a coefficient, and its key in `Motor`.
SPEED_LIMIT, SPEED_LIMIT_KEY = "maxRotVelocity", "max_rotor_velocity"

MOTOR_CONSTANT = "motorConstant"
CENTER_OF_MASS = tuple(f"center_of_mass_{axis}" for axis in "xyz")


def _entries() -> dict[str, Written]:
    """Return coefficient -> its tag and parent element."""
    return {
        name: entry
        for name, row in COEFFICIENTS.items()
        if isinstance(entry := row.exported_as.get("sdf"), Written)
    }


def tags_in(parent: Parent) -> dict[str, str]:
    """Return tag -> name of its number.

    Parameters
    ----------
    parent
        Their parent element: ``motor`` is a motor model plugin of Gazebo classic or gz-sim,
        ``channel`` a control channel of PX4's interface plugin for Gazebo classic.
    """
    limit = {SPEED_LIMIT: SPEED_LIMIT_KEY} if parent == "motor" else {}
    return limit | {e.tag: name for name, e in _entries().items() if e.parent == parent}


def numbers_of(vehicle: VehicleFile) -> dict[str, float]:
    """Return name -> value of all numbers that may have a tag."""
    return values_of(vehicle) | {SPEED_LIMIT_KEY: vehicle.motor.max_rotor_velocity}


def tag_values(vehicle: VehicleFile, parent: Parent) -> dict[str, float]:
    """Return tag -> value of a vehicle, without coefficients that it lacks."""
    numbers = numbers_of(vehicle)
    return {tag: numbers[name] for tag, name in tags_in(parent).items() if name in numbers}


def center_of_mass(vehicle: VehicleFile) -> tuple[float, ...] | None:
    """Return the m from the origin of rotor positions to the centre of mass; None if equal."""
    if not any(vehicle.effects.get(name) for name in CENTER_OF_MASS):
        return None
    return tuple(vehicle.effects.get(name, 0.0) for name in CENTER_OF_MASS)


def motor_constants(vehicle: VehicleFile) -> dict[str, float] | None:
    """Return name -> each rotor's motor constant; None if all are equal.

    The product of the rotors' scales of thrust and torque is 1, from which the last one follows.
    """
    count = len(vehicle.rotors)
    scales = [vehicle.effects.get(f"rotor_thrust_scale_{i + 1}") for i in range(count)]
    if all(scale in (None, 1.0) for scale in scales):
        return None
    if scales[-1] is None:
        scales[-1] = 1.0 / math.prod(scale for scale in scales if scale is not None)
    constant = vehicle.aerodynamics.motor_constant
    return {
        rotor_constant_name(i): constant if scale is None else constant * scale
        for i, scale in enumerate(scales)
    }


def rotor_constant_name(index: int) -> str:
    """Return the name of one rotor's motor constant."""
    return f"motor_constant of rotor_{index}"


def carried_values(vehicle: VehicleFile, *, channels: bool) -> dict[str, float]:
    """Return name -> value of the numbers that a model of a vehicle must hold.

    Parameters
    ----------
    channels
        Whether it has control channels, as for Gazebo classic.
    """
    tagged = {name for name, e in _entries().items() if channels or e.parent != "channel"}
    numbers = {
        name: value
        for name, value in numbers_of(vehicle).items()
        if name in tagged | {SPEED_LIMIT_KEY} and name not in vehicle.effects
    }
    uneven, centre = motor_constants(vehicle), center_of_mass(vehicle)
    if centre is not None:
        numbers |= dict(zip(CENTER_OF_MASS, centre, strict=True))
    if uneven is not None:
        del numbers["motor_constant"]
        numbers |= uneven
    return numbers


def as_text(value: float) -> str:
    """Return a number as text of at most twelve digits."""
    return format(value, ".12g")


def with_model_values(vehicle: VehicleFile, read: dict[str, float]) -> VehicleFile:
    """Return a vehicle with the numbers of a model, except uneven rotors' motor constants."""
    limit = read[SPEED_LIMIT_KEY]
    coefficients = {name: value for name, value in read.items() if name in COEFFICIENTS}
    flown = with_values(vehicle, coefficients)
    return flown.replace(motor=flown.motor.replace(max_rotor_velocity=limit))


def plugin_deviations(vehicle: VehicleFile) -> tuple[str, ...]:
    """Return clauses on properties of a vehicle that the plugins fly differently."""
    if vehicle.aerodynamics.reaction_torque == "body":
        return ()
    return ("the plugins' reaction torque acts about the body's z axis, not the world's",)


def read_values(model: Model, vehicle: VehicleFile) -> dict[str, float]:
    """Return name -> value of the numbers in a model.

    Parameters
    ----------
    model
        As rendered.
    vehicle
        Gives the rotors, whether they are equal, and whether rotor positions count from its
        centre of mass.

    Raises
    ------
    ExportError
        Its rotors have different values.
    """
    motor_tags, read = tags_in("motor"), dict[str, float]()
    if motor_constants(vehicle) is not None:
        del motor_tags[MOTOR_CONSTANT]
        for motor in model.motors():
            index = model.motor_number(motor)
            if index is not None:
                read |= _shared_values([motor], {MOTOR_CONSTANT: rotor_constant_name(index)})
    read |= _shared_values(model.motors(), motor_tags)
    read |= _shared_values(model.channels(), tags_in("channel"))
    whole = composite(model)
    if center_of_mass(vehicle) is not None:
        origin = rotor_origin(model, vehicle)
        offset = whole.pose.position - (np.zeros(3) if origin is None else origin)
        read |= dict(zip(CENTER_OF_MASS, offset.tolist(), strict=True))
    body = {"mass": whole.mass}
    body |= {f"i{axis}{axis}": float(whole.inertia[i, i]) for i, axis in enumerate("xyz")}
    tags = tags_in("inertial") | tags_in("inertia")
    return read | {name: body[tag] for tag, name in tags.items() if tag in body}


def _shared_values(elements: Sequence[Element], tags: dict[str, str]) -> dict[str, float]:
    """Return the values that elements share."""
    read: dict[str, float] = {}
    for tag, name in tags.items():
        texts = {child.value if (child := of.find(tag)) else "" for of in elements}
        try:
            values = {float(text) if text else None for text in texts}
        except ValueError:
            raise ExportError(
                elements[0].source.path,
                f"has the <{tag}> {' and '.join(sorted(texts))}",
                "write a number",
            ) from None
        if len(values) > 1:
            path = elements[0].source.path
            raise ExportError(path, f"has rotors of different {tag}", "give them one value")
        for value in values:
            if value is not None:
                read[name] = value
    return read


def rotor_origin(model: Model, vehicle: VehicleFile) -> Array | None:
    """Return the origin (3,) m of the vehicle file's rotor positions in a model.

    None unless every rotor is a link, ``rotor_0`` and on.
    """
    links = {link.attributes.get("name"): link for link in model.links}
    places = [
        model.pose_of_link(links[name]).position - rotor.position
        for index, rotor in enumerate(vehicle.rotors)
        if (name := f"rotor_{index}") in links
    ]
    return np.mean(places, axis=0) if len(places) == len(vehicle.rotors) else None

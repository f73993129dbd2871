"""A written model read again by another parser: the numbers in it, and no others."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from lxml import etree

from tuner.core.errors import ExportError
from tuner.exporters.sdf.composite import Array, Inertial, together
from tuner.exporters.sdf.model import Model, inertials, read_model
from tuner.exporters.sdf.spans import without_comments
from tuner.exporters.sdf.tags import (
    CENTER_OF_MASS,
    MOTOR_CONSTANT,
    center_of_mass,
    motor_constants,
    of_rotor,
    tags_in,
)
from tuner.vehicle import VehicleFile


def values_in(text: str, path: Path, vehicle: VehicleFile) -> dict[str, float]:
    """Return what a rendered model holds, name -> value; what it does not hold is not there.

    Parameters
    ----------
    text, path
        The model and its name for messages.
    vehicle
        How many rotors it has and where, whether they are alike, and whether its centre of mass is
        where rotor positions count from.

    Raises
    ------
    ExportError
        It is not well-formed, or its rotors do not agree with each other.
    """
    rotors, motor_tags = len(vehicle.rotors), tags_in("motor")
    try:
        parser = etree.XMLParser(resolve_entities=False, no_network=True)
        tree = etree.fromstring(without_comments(text).encode(), parser)
    except etree.XMLSyntaxError as error:
        raise ExportError(path, f"is not well-formed XML ({error})", "correct it") from None
    ours = {str(number) for number in range(rotors)}
    plugins = [e for e in tree.iter("plugin") if _text(e, "motorNumber") in ours]
    channels = [
        e
        for e in tree.iter("channel")
        if _text(e, "input_index") in ours
        and (_text(e, "joint_control_type") or "velocity").startswith("velocity")
    ]
    read: dict[str, float] = {}
    if motor_constants(vehicle) is not None:
        del motor_tags[MOTOR_CONSTANT]
        for plugin in plugins:
            index = int(_text(plugin, "motorNumber"))
            read |= _agreed([plugin], {MOTOR_CONSTANT: of_rotor(index)}, path)
    read |= _agreed(plugins, motor_tags, path) | _agreed(channels, tags_in("channel"), path)
    model = read_model(text, path, rotors)
    whole = composite(model)
    if center_of_mass(vehicle) is not None:
        origin = rotor_origin(model, vehicle)
        offset = whole.pose.position - (np.zeros(3) if origin is None else origin)
        read |= dict(zip(CENTER_OF_MASS, offset.tolist(), strict=True))
    body = {"mass": whole.mass}
    body |= {f"i{axis}{axis}": float(whole.inertia[i, i]) for i, axis in enumerate("xyz")}
    tags = tags_in("inertial") | tags_in("inertia")
    return read | {name: body[tag] for tag, name in tags.items() if tag in body}


def _text(element: etree._Element, tag: str) -> str:
    return (element.findtext(tag) or "").strip()


def _agreed(
    elements: Iterable[etree._Element], tags: dict[str, str], path: Path
) -> dict[str, float]:
    """Return the values that elements share."""
    read: dict[str, float] = {}
    for tag, name in tags.items():
        texts = {_text(element, tag) for element in elements}
        try:
            values = {float(text) if text else None for text in texts}
        except ValueError:
            raise ExportError(
                path, f"has the <{tag}> {' and '.join(sorted(texts))}", "write a number"
            ) from None
        if len(values) > 1:
            raise ExportError(path, f"has rotors of different {tag}", "give them one value")
        for value in values:
            if value is not None:
                read[name] = value
    return read


def composite(model: Model) -> Inertial:
    """Return all links of a model as one body."""
    return together([body for _, body in inertials(model)])


def rotor_origin(model: Model, vehicle: VehicleFile) -> Array | None:
    """Return the point (3,) m of a model from which the vehicle file's rotor positions count.

    None where not every rotor is a link of its own, ``rotor_0`` and on.
    """
    links = {link.attributes.get("name"): link for link in model.links}
    places = [
        model.pose_of_link(links[name]).position - rotor.position
        for index, rotor in enumerate(vehicle.rotors)
        if (name := f"rotor_{index}") in links
    ]
    return np.mean(places, axis=0) if len(places) == len(vehicle.rotors) else None

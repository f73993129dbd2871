"""A written model read again by another parser, as the vehicle that the simulator will fly."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from lxml import etree
from pydantic import ValidationError

from tuner.config import VehicleFile
from tuner.errors import ExportError
from tuner.export.sdf.composite import Inertial, together
from tuner.export.sdf.model import Model, inertials, read_model
from tuner.export.sdf.spans import without_comments
from tuner.export.sdf.tags import CHANNEL_TAGS, MOTOR_TAGS, as_flown

ROTOR_NUMBERS = ("0", "1", "2", "3")


def vehicle_in(text: str, path: Path, like: VehicleFile) -> VehicleFile:
    """Return the vehicle that a rendered model holds.

    Parameters
    ----------
    text, path
        The model and its name for messages.
    like
        Gives what the format has no place for.

    Raises
    ------
    ExportError
        It is not well-formed, or its rotors do not agree with each other.
    """
    try:
        parser = etree.XMLParser(resolve_entities=False, no_network=True)
        tree = etree.fromstring(without_comments(text).encode(), parser)
    except etree.XMLSyntaxError as error:
        raise ExportError(path, f"is not well-formed XML ({error})", "correct it") from None
    model = read_model(text, path)
    data = as_flown(like).model_dump()
    plugins = [found for found in tree.iter("plugin") if found.find("motorNumber") is not None]
    channels = [found for found in tree.iter("channel") if found.find("input_scaling") is not None]
    for elements, numbers, tags in (
        (plugins, "motorNumber", MOTOR_TAGS),
        (channels, "input_index", CHANNEL_TAGS),
    ):
        ours = [e for e in elements if (e.findtext(numbers) or "").strip() in ROTOR_NUMBERS]
        for tag, (section, key) in tags.items():
            values = {float(found.findtext(tag) or "nan") for found in ours}
            if len(values) > 1:
                raise ExportError(path, f"has rotors of different {tag}", "give them one value")
            for value in values:
                data[section][key] = value
    whole = composite(model)
    moments = np.diag(whole.inertia)
    data["mass"] = whole.mass
    data["inertia"] = {axis: float(m) for axis, m in zip(("xx", "yy", "zz"), moments, strict=True)}
    try:
        return VehicleFile.model_validate(data)
    except ValidationError as error:
        detail = error.errors()[0]
        raise ExportError(
            path, f"holds {detail['loc']} {detail['input']!r}", detail["msg"]
        ) from None


def composite(model: Model) -> Inertial:
    """Return all links of a model as one body."""
    return together([body for _, body in inertials(model)])

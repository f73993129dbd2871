"""A vehicle's coefficients into a model: which tags are ours, and what each becomes."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from tuner.config import VehicleFile
from tuner.errors import ExportError
from tuner.exporters.draft import Draft, differences, read_file
from tuner.exporters.sdf import spans, tags
from tuner.exporters.sdf.composite import Array, Inertial, base_for, together
from tuner.exporters.sdf.model import Model, inertials, read_model
from tuner.exporters.sdf.read_back import rotor_origin, values_in
from tuner.exporters.sdf.spans import Edit, Element
from tuner.exporters.sdf.template import blanked, rendered

#: Products of inertia below this part of the trace are taken as none.
NO_PRODUCT = 1e-9
PROVENANCE = "Coefficients by tune"

#: m within which a rotor counts as sitting where the vehicle file has it.
PLACE_TOLERANCE = 0.005


def sdf_draft(path: Path, vehicle: VehicleFile, provenance: str) -> Draft:
    """Put a vehicle's coefficients into a model, leaving every other character as it is.

    Parameters
    ----------
    path
        The model: SDF of Gazebo classic or gz-sim, or a Jinja template of one.
    vehicle
        Whose coefficients.
    provenance
        One line that says where they come from; it becomes a comment in the model.

    Raises
    ------
    ExportError
        The model cannot be understood, or would not come out with the wanted numbers.
    """
    text = read_file(path)
    blank = blanked(text)
    rotors = len(vehicle.rotors)
    model = read_model(blank, path, rotors)
    whole = read_model(rendered(text, path), path, rotors)
    base = _base(whole, vehicle)
    edits = [*_inertial_edits(model, base), *_motor_edits(model, vehicle)]
    if tags.center_of_mass(vehicle) is not None:
        edits += _pose_edits(model, whole, base)
    edits = [_through_variable(text, blank, edit, path) for edit in edits]
    edits.append(_provenance_edit(text, model, provenance))
    edits = list(dict.fromkeys(edits))
    _refuse_contradictions(edits, path)
    patched = spans.apply(text, edits)
    wanted = tags.carried_values(vehicle, channels=bool(whole.channels()))
    written_values = values_in(rendered(patched, path), path, vehicle)
    wrong = differences(wanted, written_values)
    if wrong:
        raise ExportError(path, f"would come out with {'; '.join(wrong)}", "nothing was written")
    return Draft(
        patched,
        tags.as_flown(vehicle, written_values),
        tuple(_notes(whole, vehicle, base)),
        lambda written: differences(
            wanted, values_in(rendered(read_file(written), written), written, vehicle)
        ),
    )


def _base(model: Model, vehicle: VehicleFile) -> Inertial:
    """Return the base link's body that makes the whole model weigh and turn like the vehicle.

    It moves only for a vehicle whose centre of mass is not where rotor positions count from.
    """
    others = [body for link, body in inertials(model) if link is not model.base]
    inertia, offset, centre = vehicle.inertia, tags.center_of_mass(vehicle), None
    if offset is not None:
        origin = rotor_origin(model, vehicle)
        if origin is None:
            raise ExportError(
                model.path,
                "shows no places of rotors to put the centre of mass against",
                f"call their links rotor_0 to rotor_{len(vehicle.rotors) - 1}",
            )
        centre = origin + np.array(offset)
    try:
        return base_for(
            vehicle.mass,
            np.diag([inertia.xx, inertia.yy, inertia.zz]),
            model.pose_of_inertial(model.base),
            others,
            centre=centre,
        )
    except ValueError as error:
        raise ExportError(
            model.path, str(error), "lighten those links, or give another model"
        ) from None


def _inertial_edits(model: Model, base: Inertial) -> Iterator[Edit]:
    inertial = model.base.find("inertial")
    tensor = inertial.find("inertia") if inertial else None
    if inertial is None or tensor is None:
        raise ExportError(
            model.path,
            f"base link '{model.base.attributes.get('name')}' has no <inertial> with <inertia>",
            "give it one, its numbers do not matter",
        )
    yield from _set(inertial, model.text, {"mass": base.mass})
    entries = base.inertia
    yield from _set(
        tensor, model.text, {"ixx": entries[0, 0], "iyy": entries[1, 1], "izz": entries[2, 2]}
    )
    products = {"ixy": entries[0, 1], "ixz": entries[0, 2], "iyz": entries[1, 2]}
    for tag, value in products.items():
        none = abs(value) < NO_PRODUCT * np.trace(entries)
        if not none or tensor.find(tag) is not None:
            yield from _set(tensor, model.text, {tag: 0.0 if none else value})


def _pose_edits(model: Model, whole: Model, base: Inertial) -> Iterator[Edit]:
    """Yield the edit that puts the base's inertial frame where the base's centre lies.

    ``model`` is the text to edit, ``whole`` what it is once rendered. The frame's angles stay as
    they are written; places have all digits, for the centre is the small difference of large ones.
    """
    link = whole.pose_of_link(whole.base)
    place = link.rotation.T @ (base.pose.position - link.position)
    inertial = model.base.find("inertial")
    assert inertial is not None, "its mass was set"
    pose = inertial.find("pose")
    angles = spans.content(pose, model.text).split()[3:] if pose else ["0", "0", "0"]
    written = " ".join([*(repr(float(number)) for number in place), *(angles or ["0", "0", "0"])])
    if pose is None:
        yield spans.append_child(inertial, model.text, "pose", written)
    elif spans.content(pose, model.text) != written:
        yield spans.set_value(pose, model.text, written)


def _refuse_contradictions(edits: Sequence[Edit], path: Path) -> None:
    """Refuse a model that says once what differs from rotor to rotor.

    Raises
    ------
    ExportError
        Two edits of the same place differ.
    """
    places = [(edit.start, edit.end) for edit in edits if edit.end > edit.start]
    if len(set(places)) < len(places):
        raise ExportError(
            path,
            "sets the motorConstant of all rotors at once, and this vehicle's differ",
            "give each rotor's plugin a number of its own",
        )


def _motor_edits(model: Model, vehicle: VehicleFile) -> Iterator[Edit]:
    uneven = tags.motor_constants(vehicle)
    for motor in model.motors():
        wanted = tags.values(vehicle, "motor")
        if uneven is not None:
            index = model.motor_number(motor)
            if index is None:
                raise ExportError(
                    model.path,
                    "draws its rotors from a template, and this vehicle's differ in motor_constant",
                    "give each rotor a plugin of its own",
                )
            wanted[tags.MOTOR_CONSTANT] = uneven[tags.of_rotor(index)]
        yield from _set(motor, model.text, wanted)
    for channel in model.channels():
        yield from _set(channel, model.text, tags.values(vehicle, "channel"))


def _set(parent: Element, text: str, values: dict[str, float]) -> Iterator[Edit]:
    """Yield the edits that give children values; those that have them already stay untouched."""
    for tag, value in values.items():
        child = parent.find(tag)
        if child is None:
            yield spans.append_child(parent, text, tag, tags.as_text(value))
        else:
            now = spans.number(child, text)
            if now is None or tags.as_text(now) != tags.as_text(value):
                yield spans.set_value(child, text, tags.as_text(value))


def _through_variable(text: str, blank: str, edit: Edit, path: Path) -> Edit:
    """Return an edit of a ``{{ variable }}`` as an edit of the number it is set to."""
    old = text[edit.start : edit.end]
    if old == blank[edit.start : edit.end]:
        return edit
    name = re.fullmatch(r"\s*\{\{-?\s*(\w+)\s*-?\}\}\s*", old)
    settings = (
        re.finditer(rf"\{{%-?\s*set\s+{name.group(1)}\s*=\s*([-+.\deE]+)\s*-?%\}}", text)
        if name
        else iter(())
    )
    assignments = list(settings)
    if len(assignments) != 1:
        raise ExportError(
            path,
            f"has the expression {old.strip()} where a number of ours belongs",
            "write a number there, or set its variable to a number once",
        )
    return Edit(assignments[0].start(1), assignments[0].end(1), edit.text)


def _provenance_edit(text: str, model: Model, provenance: str) -> Edit:
    """Return the edit that puts our comment first in the model, in place of an earlier one."""
    comment = f"<!-- {PROVENANCE}: {provenance.replace('--', '- -')} -->"
    earlier = re.search(rf"<!-- {PROVENANCE}: .*?-->", text, re.DOTALL)
    if earlier:
        return Edit(earlier.start(), earlier.end(), comment)
    first = model.root.children[0]
    before = text[text.rfind("\n", 0, first.start) + 1 : first.start]
    indent = "\n" + before if not before.strip() else ""
    return Edit(model.root.content, model.root.content, indent + comment)


def _notes(model: Model, vehicle: VehicleFile, base: Inertial) -> Iterator[str]:
    """Yield what was done, and what of the vehicle the format has no place for."""
    name = model.base.attributes.get("name", "")
    others = [(link, body) for link, body in inertials(model) if link is not model.base]
    if others:
        names = ", ".join(link.attributes.get("name", "") for link, _ in others)
        yield (
            f"the vehicle's {tags.as_text(vehicle.mass)} kg and inertia are those of all links "
            f"together: '{name}' gets {tags.as_text(base.mass)} kg and what inertia {names} leave"
        )
    if model.included:
        yield f"the mass of what the model includes is not counted: {', '.join(model.included)}"
    centre = together([base, *(body for _, body in others)]).pose.position
    for rotor, expected in _rotor_places(model, vehicle, centre):
        yield (
            f"{rotor}, which the vehicle file puts {expected} m from it; the model's geometry is "
            "left as it is"
        )
    motor = vehicle.motor
    if not model.channels():
        last = len(vehicle.rotors)
        low = motor.input_offset * motor.input_scaling + motor.zero_position_armed
        yield (
            "the model has no control channels (gz-sim has them in PX4's parameters): set "
            f"SIM_GZ_EC_MIN1..{last} to {low:.0f} and SIM_GZ_EC_MAX1..{last} to "
            f"{low + motor.input_scaling:.0f}, as the px4 export does"
        )
    if tags.center_of_mass(vehicle) is not None:
        place = ", ".join(tags.as_text(round(number, 9)) for number in base.pose.position)
        yield f"the inertial of '{name}' moves to ({place}) m for the vehicle's centre of mass"
    yield from tags.lost_in(vehicle)


def _rotor_places(model: Model, vehicle: VehicleFile, centre: Array) -> Iterator[tuple[str, str]]:
    """Yield the rotors whose place from the centre of mass is not the vehicle file's."""
    links = {link.attributes.get("name"): link for link in model.links}
    offset = np.array(tags.center_of_mass(vehicle) or (0.0, 0.0, 0.0))
    for index, rotor in enumerate(vehicle.rotors):
        link = links.get(f"rotor_{index}")
        if link is not None:
            place = model.pose_of_link(link).position - centre
            expected = np.array(rotor.position) - offset
            if np.abs(place - expected).max() > PLACE_TOLERANCE:
                yield (
                    f"rotor_{index} sits {place.round(4).tolist()} m from the centre of mass",
                    str(expected.round(4).tolist()),
                )

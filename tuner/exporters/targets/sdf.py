"""SDF of Gazebo classic or gz-sim: a patched model, or the tags alone."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jinja2 import Environment, StrictUndefined
from pydantic import ValidationError

from tuner.core.errors import ExportError
from tuner.exporters.sdf import spans, tags
from tuner.exporters.sdf.model import (
    MAX_ROTORS,
    Inertial,
    Model,
    base_for,
    composite,
    inertials,
    read_model,
)
from tuner.exporters.sdf.spans import MERGED, Edit, Element, parse, read_tree, render, without_jinja
from tuner.exporters.sdf.tags import read_values, rotor_origin
from tuner.exporters.simulators import (
    GAZEBO_CLASSIC,
    GZ_SIM,
    MAX_GZ_SPEED,
    Simulator,
    gz_speed_unit,
    rotor_speed,
    with_speed_unit,
)
from tuner.exporters.target import (
    PLACE_TOLERANCE_M,
    Draft,
    Target,
    differences,
    read_file,
    xml_comment,
)
from tuner.result import Gate
from tuner.vehicle import VehicleFile

#: Products of inertia below this share of the trace are zero.
MAX_ZERO_PRODUCT = 1e-9
PROVENANCE = "Coefficients by tune"
TEMPLATE = Path(__file__).parents[1] / "sdf" / "snippet.sdf.jinja"


def sdf_or_snippet(
    vehicle: VehicleFile, provenance: str, simulator: Simulator, into: Path | None
) -> Draft:
    """Return a model with a vehicle's numbers, or the tags alone.

    These are inertial, motor plugins and, for Gazebo classic, control channels.
    """
    if into is not None:
        return sdf_draft(into, vehicle, provenance)

    def held_by(text: str, path: Path) -> dict[str, float]:
        model = parse(f"<model><link name='base_link'>{text}</link></model>", path)
        return read_values(read_model(model, len(vehicle.rotors)), vehicle)

    notes = tags.plugin_deviations(vehicle)
    vehicle = simulator.flown(vehicle)
    unit = gz_speed_unit(vehicle) if simulator is GZ_SIM else 1.0
    vehicle = with_speed_unit(vehicle, unit)
    wanted = tags.carried_values(vehicle, channels=simulator is not GZ_SIM)
    text = _snippet(vehicle, simulator, provenance)
    there = tags.with_model_values(vehicle, wanted | held_by(text, TEMPLATE))
    return Draft(
        text,
        with_speed_unit(there, 1.0 / unit),
        notes,
        lambda path, _: differences(wanted, held_by(read_file(path), path)),
    )


def _snippet(vehicle: VehicleFile, simulator: Simulator, provenance: str) -> str:
    environment = Environment(
        undefined=StrictUndefined, keep_trailing_newline=True, autoescape=True
    )
    inertia, centre = vehicle.inertia, tags.center_of_mass(vehicle)
    motors = [
        {tag: tags.as_text(value) for tag, value in _motor_values(vehicle, index).items()}
        for index in range(len(vehicle.rotors))
    ]
    return environment.from_string(TEMPLATE.read_text(encoding="utf-8")).render(
        provenance=xml_comment(provenance),
        simulator=simulator.name,
        mass=tags.as_text(vehicle.mass),
        ixx=tags.as_text(inertia.xx),
        iyy=tags.as_text(inertia.yy),
        izz=tags.as_text(inertia.zz),
        center_of_mass=None if centre is None else " ".join(map(tags.as_text, centre)),
        rotors=list(zip(vehicle.rotors, motors, strict=True)),
        channel={
            tag: tags.as_text(value) for tag, value in tags.tag_values(vehicle, "channel").items()
        },
    )


def _motor_values(vehicle: VehicleFile, index: int) -> dict[str, float]:
    """Return tag -> value of one rotor's motor plugin."""
    values, uneven = tags.tag_values(vehicle, "motor"), tags.motor_constants(vehicle)
    if uneven is not None:
        values[tags.MOTOR_CONSTANT] = uneven[tags.rotor_constant_name(index)]
    return values


def sdf_draft(path: Path, vehicle: VehicleFile, provenance: str) -> Draft:
    """Put a vehicle's coefficients into a model, leaving every other character as it is.

    Parameters
    ----------
    path
        The model: SDF of Gazebo classic or gz-sim, or a Jinja template of one. Models that it
        merges from folders beside its own are patched, too.
    provenance
        One line on their origin, for a comment in each changed file.

    Raises
    ------
    ExportError
        The model is not understood, or would not hold the wanted numbers.
    """
    rotors = len(vehicle.rotors)
    model = read_model(read_tree(path, read_file, lambda text, _: without_jinja(text)), rotors)
    whole = read_model(read_tree(path, read_file, render), rotors)
    simulator = GZ_SIM if whole.is_gz else GAZEBO_CLASSIC
    flown = simulator.flown(vehicle)
    unit = gz_speed_unit(flown) if whole.is_gz else 1.0
    vehicle, asked = with_speed_unit(flown, unit), vehicle
    base = _base_body(whole, vehicle)
    edits = [*_inertial_edits(model, base), *_motor_edits(model, vehicle)]
    if tags.center_of_mass(vehicle) is not None:
        edits += _pose_edits(model, whole, base)
    edits = list(dict.fromkeys(map(_edit_of_variable, edits)))
    places = [(edit.source, edit.start, edit.end) for edit in edits if edit.end > edit.start]
    if len(set(places)) < len(places):
        raise ExportError(
            path,
            "sets the motorConstant of all rotors at once, and this vehicle's differ",
            "give each rotor's plugin a number of its own",
        )
    patched = _patched(model, edits, provenance)

    def faults(file: Path, instead: Mapping[Path, Path]) -> list[str]:
        standing = {**instead, path: file}
        root = read_tree(path, lambda p: read_file(standing.get(p, p)), render)
        return differences(wanted, read_values(read_model(root, rotors), vehicle))

    root = read_tree(path, lambda p: patched.get(p) or read_file(p), render)
    final = read_model(root, rotors)
    wanted = tags.carried_values(vehicle, channels=bool(whole.channels()))
    written_values = read_values(final, vehicle)
    wrong = differences(wanted, written_values)
    if wrong:
        raise ExportError(path, f"would come out with {'; '.join(wrong)}", "nothing was written")
    there, geometry = _rotors_there(final, tags.with_model_values(vehicle, written_values))
    return Draft(
        patched.pop(path, model.root.source.raw),
        with_speed_unit(there, 1.0 / unit),
        tuple(_notes(whole, asked, vehicle, base, unit)),
        faults,
        gates=(Gate("rotors sit and turn there as the vehicle's do", geometry),),
        others=patched,
    )


def simulator_of(path: Path) -> str:
    """Return the name of a model's simulator.

    Raises
    ------
    ExportError
        It is no model of a multirotor.
    """
    model = read_model(read_tree(path, read_file, render), MAX_ROTORS)
    return (GZ_SIM if model.is_gz else GAZEBO_CLASSIC).name


def _patched(model: Model, edits: Sequence[Edit], provenance: str) -> dict[Path, str]:
    """Return changed file -> its new text, with a comment on the origin in its model."""
    merged = (include.children[0] for include in model.root.all(MERGED))
    begins = {element.source: element for element in (*merged, model.root)}
    patched = {}
    for source, element in begins.items():
        of_file = [edit for edit in edits if edit.source == source]
        if of_file or len(begins) == 1:
            comment = _provenance_edit(element, provenance)
            patched[source.path] = spans.apply_edits(source.raw, [*of_file, comment])
    return patched


def _base_body(model: Model, vehicle: VehicleFile) -> Inertial:
    """Return the base link's body with which the model has the vehicle's mass and inertia.

    It moves only if the centre of mass is not the origin of rotor positions.
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
        more = _more_rotors(model, vehicle)
        what = f"is of another vehicle: {more}" if more else str(error)
        remedy = (
            "give a model of this one" if more else "lighten those links, or give another model"
        )
        raise ExportError(model.path, what, remedy) from None


def _inertial_edits(model: Model, base: Inertial) -> Iterator[Edit]:
    inertial = model.base.find("inertial")
    tensor = inertial.find("inertia") if inertial else None
    if inertial is None or tensor is None:
        raise ExportError(
            model.path,
            f"base link '{model.base.attributes.get('name')}' has no <inertial> with <inertia>",
            "give it one, its numbers do not matter",
        )
    yield from _value_edits(inertial, {"mass": base.mass})
    smallest = MAX_ZERO_PRODUCT * np.trace(base.inertia)
    for row, column in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)):
        tag, value = f"i{'xyz'[row]}{'xyz'[column]}", base.inertia[row, column]
        none = abs(value) < smallest and row != column
        if not none or tensor.find(tag) is not None:
            yield from _value_edits(tensor, {tag: 0.0 if none else value})


def _pose_edits(model: Model, whole: Model, base: Inertial) -> Iterator[Edit]:
    """Yield the edit that moves the base's inertial frame to the base's centre of mass.

    ``model`` is the text to edit, ``whole`` the rendered model. The frame's angles stay; its
    position has all digits, for the centre is the small difference of large numbers.
    """
    link = whole.pose_of_link(whole.base)
    place = link.rotation.T @ (base.pose.position - link.position)
    inertial = model.base.find("inertial")
    assert inertial is not None, "its mass was set"
    pose = inertial.find("pose")
    angles = pose.value.split()[3:] if pose else ["0", "0", "0"]
    written = " ".join([*(repr(float(number)) for number in place), *(angles or ["0", "0", "0"])])
    if pose is None:
        yield spans.append_child(inertial, "pose", written)
    elif pose.value != written:
        yield spans.set_value(pose, written)


def _motor_edits(model: Model, vehicle: VehicleFile) -> Iterator[Edit]:
    for motor in model.motors():
        index = model.motor_number(motor)
        if index is None and tags.motor_constants(vehicle) is not None:
            raise ExportError(
                model.path,
                "draws its rotors from a template, and this vehicle's differ in motor_constant",
                "give each rotor a plugin of its own",
            )
        yield from _value_edits(motor, _motor_values(vehicle, index or 0))
    for channel in model.channels():
        yield from _value_edits(channel, tags.tag_values(vehicle, "channel"))


def _value_edits(parent: Element, values: dict[str, float]) -> Iterator[Edit]:
    """Yield the edits that set the values of children, without those that are equal already."""
    for tag, value in values.items():
        child = parent.find(tag)
        if child is None:
            yield spans.append_child(parent, tag, tags.as_text(value))
        else:
            now = child.number
            if now is None or tags.as_text(now) != tags.as_text(value):
                yield spans.set_value(child, tags.as_text(value))


def _edit_of_variable(edit: Edit) -> Edit:
    """Return an edit of a ``{{ variable }}`` as an edit of the variable's number."""
    source, place = edit.source, slice(edit.start, edit.end)
    old = source.raw[place]
    if old == source.text[place]:
        return edit
    name = re.fullmatch(r"\s*\{\{-?\s*(\w+)\s*-?\}\}\s*", old)
    settings = rf"\{{%-?\s*set\s+{name.group(1)}\s*=\s*([-+.\deE]+)\s*-?%\}}" if name else "(?!)"
    assignments = list(re.finditer(settings, source.raw))
    if len(assignments) != 1:
        raise ExportError(
            source.path,
            f"has the expression {old.strip()} where a number of ours belongs",
            "write a number there, or set its variable to a number once",
        )
    return Edit(source, assignments[0].start(1), assignments[0].end(1), edit.text)


def _provenance_edit(model: Element, provenance: str) -> Edit:
    """Return the edit that adds our comment to a model, or replaces an earlier one."""
    comment = f"<!-- {PROVENANCE}: {xml_comment(provenance)} -->"
    earlier = re.search(rf"<!-- {PROVENANCE}: .*?-->", model.source.raw, re.DOTALL)
    if earlier:
        return Edit(model.source, earlier.start(), earlier.end(), comment)
    first = spans.indent_of(model.children[0])
    return Edit(model.source, model.content, model.content, first + comment)


def _notes(
    model: Model, asked: VehicleFile, vehicle: VehicleFile, base: Inertial, unit: float
) -> Iterator[str]:
    """Yield remarks on the patched model, and on properties that the format lacks."""
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
    if model.is_gz:
        low, high = (rotor_speed(vehicle, command) for command in (0.0, 1.0))
        last = len(vehicle.rotors)
        yield (
            "gz-sim has no control channels, PX4's parameters map commands: set "
            f"SIM_GZ_EC_MIN1..{last} to {low:.0f} and SIM_GZ_EC_MAX1..{last} to {high:.0f}, as "
            "--format px4 --simulator gz-sim does"
        )
    if unit < 1:
        yield (
            f"rotors turn at up to {rotor_speed(vehicle, 1.0) / unit:.0f} rad/s and PX4 lets "
            f"gz-sim be told of {MAX_GZ_SPEED:.0f} at most: speeds are scaled by {unit:.6g} and "
            "motorConstant and rotorDragCoefficient to match, which moves nothing otherwise"
        )
    if tags.center_of_mass(vehicle) is not None:
        place = ", ".join(tags.as_text(round(number, 9)) for number in base.pose.position)
        yield f"the inertial of '{name}' moves to ({place}) m for the vehicle's centre of mass"
    yield from tags.plugin_deviations(asked)


def _more_rotors(model: Model, vehicle: VehicleFile) -> str:
    """Return a clause if a model has more rotors than a vehicle; else an empty text."""
    count, own = len(replace(model, rotors=MAX_ROTORS).rotor_links()), len(vehicle.rotors)
    return f"the model has {count} rotors, the vehicle {own}" if count > own else ""


def _rotors_there(model: Model, vehicle: VehicleFile) -> tuple[VehicleFile, tuple[str, ...]]:
    """Return a vehicle with a model's rotors, and a clause for each difference of its own."""
    more = _more_rotors(model, vehicle)
    clauses, rotors = [more] if more else [], list(vehicle.rotors)
    centre = composite(model).pose.position
    offset = np.array(tags.center_of_mass(vehicle) or (0.0, 0.0, 0.0))
    for index, (link, turns) in sorted(model.rotor_links().items()):
        rotor, place = rotors[index], model.pose_of_link(link).position - centre
        expected = np.array(rotor.position) - offset
        if np.abs(place - expected).max() > PLACE_TOLERANCE_M:
            clauses.append(
                f"rotor_{index} sits {place.round(4).tolist()} m from the centre of mass, the "
                f"vehicle file's {expected.round(4).tolist()} m"
            )
            rotors[index] = rotor.replace(position=tuple((place + offset).tolist()))
        if turns and turns != rotor.spin:
            clauses.append(f"rotor_{index} turns {turns}, the vehicle file's {rotor.spin}")
        if turns in ("ccw", "cw"):
            rotors[index] = rotors[index].replace(spin=turns)
    try:
        return vehicle.replace(rotors=tuple(rotors)), tuple(clauses)
    except ValidationError:  # a gate reports another order than the mixer's
        return vehicle, tuple(clauses)


TARGET = Target(
    "sdf",
    ".sdf",
    sdf_or_snippet,
    simulator=GAZEBO_CLASSIC,
    others=(GZ_SIM,),
    simulator_of=simulator_of,
)

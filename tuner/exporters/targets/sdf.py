"""SDF of Gazebo classic or gz-sim: a patched model, or the tags alone."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jinja2 import Environment, StrictUndefined
from pydantic import ValidationError

from tuner.core.errors import ExportError
from tuner.core.numerics import Array
from tuner.exporters import laws
from tuner.exporters.sdf import spans
from tuner.exporters.sdf.model import (
    MAX_ROTORS,
    MERGED,
    Inertial,
    SdfModel,
    base_for,
    composite,
    inertials,
    motor_number,
    read_sdf,
    sdf_of,
)
from tuner.exporters.sdf.spans import Edit, Element, parse, without_jinja
from tuner.exporters.simulators import GAZEBO_CLASSIC, GZ_SIM, Simulator
from tuner.exporters.target import (
    PLACE_TOLERANCE_M,
    Draft,
    Target,
    differences,
    read_file,
    xml_comment,
)
from tuner.result import Gate
from tuner.vehicle import COEFFICIENTS, ExportTag, VehicleFile, values_of

#: Products of inertia below this share of the trace are zero.
MAX_ZERO_PRODUCT = 1e-9
PROVENANCE = "Coefficients by tune"
TEMPLATE = Path(__file__).parents[1] / "sdf" / "snippet.sdf.jinja"
SPEED_LIMIT = "max_rotor_velocity"
"""The number of a motor plugin's tag ``maxRotVelocity``, which is no coefficient."""


# numbers: of a vehicle, their tags, and those in a model


def _entries() -> dict[str, ExportTag]:
    """Return coefficient -> its tag and parent element."""
    return {
        name: entry
        for name, row in COEFFICIENTS.items()
        if isinstance(entry := row.exported_as.get("sdf"), ExportTag)
    }


def motor_tags(vehicle: VehicleFile, index: int | None) -> dict[str, str]:
    """Return tag -> name of the numbers in a rotor's motor plugin."""
    tags = {"maxRotVelocity": SPEED_LIMIT}
    tags |= {entry.tag: name for name, entry in _entries().items() if entry.parent == "motor"}
    if rotor_constants(vehicle):
        tags["motorConstant"] = f"motor_constant of rotor_{index}"
    return tags


def channel_tags() -> dict[str, str]:
    """Return tag -> name in a control channel of PX4's interface plugin for Gazebo classic."""
    return {entry.tag: name for name, entry in _entries().items() if entry.parent == "channel"}


def _tagged(model: SdfModel, vehicle: VehicleFile) -> Iterator[tuple[Element, dict[str, str]]]:
    """Yield each motor plugin and control channel, with tag -> name of the numbers in it."""
    for motor in model.motors():
        yield motor, motor_tags(vehicle, motor_number(motor))
    for channel in model.channels():
        yield channel, channel_tags()


def center_of_mass(vehicle: VehicleFile) -> dict[str, float]:
    """Return name -> m from the origin of rotor positions to the centre of mass; empty if equal."""
    offset = {name: vehicle.effects.get(name, 0.0) for name in laws.CENTRE}
    return offset if any(offset.values()) else {}


def rotor_constants(vehicle: VehicleFile) -> dict[str, float]:
    """Return name -> each rotor's motor constant; empty if all are equal.

    The product of the rotors' scales of thrust and torque is 1, from which the last one follows.
    """
    count = len(vehicle.rotors)
    scales = [vehicle.effects.get(f"rotor_thrust_scale_{i + 1}") for i in range(count)]
    if all(scale in (None, 1.0) for scale in scales):
        return {}
    known = [1.0 if scale is None else scale for scale in scales]
    if scales[-1] is None:
        known[-1] = 1.0 / math.prod(known)
    constant = vehicle.aerodynamics.motor_constant
    return {f"motor_constant of rotor_{i}": constant * scale for i, scale in enumerate(known)}


def numbers_of(vehicle: VehicleFile, *, channels: bool = True) -> dict[str, float]:
    """Return name -> value of the numbers that a model of a vehicle must hold.

    Parameters
    ----------
    channels
        Whether it has control channels, as for Gazebo classic.
    """
    entries, values = _entries(), values_of(vehicle)
    numbers = {SPEED_LIMIT: vehicle.motor.max_rotor_velocity} | {
        name: values[name]
        for name, entry in entries.items()
        if name in values and name not in vehicle.effects
        if channels or entry.parent != "channel"
    }
    uneven = rotor_constants(vehicle)
    if uneven:
        del numbers["motor_constant"]
    return numbers | center_of_mass(vehicle) | uneven


def read_values(model: SdfModel, vehicle: VehicleFile) -> dict[str, float]:
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
    read: dict[str, float | None] = {}
    for element, tags in _tagged(model, vehicle):
        held = element.numbers
        for tag, name in tags.items():
            if read.setdefault(name, held.get(tag)) != held.get(tag):
                raise ExportError(
                    element.source.path, f"has rotors of different {tag}", "give them one value"
                )
    whole = composite(model)
    if center_of_mass(vehicle):
        origin = rotor_origin(model, vehicle)
        offset = whole.pose.position - (np.zeros(3) if origin is None else origin)
        read |= {f"center_of_mass_{axis}": float(offset[i]) for i, axis in enumerate("xyz")}
    body = {f"inertia_{axis}{axis}": float(whole.inertia[i, i]) for i, axis in enumerate("xyz")}
    known = {name: value for name, value in read.items() if value is not None}
    return known | body | {"mass": whole.mass}


def rotor_origin(model: SdfModel, vehicle: VehicleFile) -> Array | None:
    """Return the origin (3,) m of the vehicle file's rotor positions in a model.

    None unless every rotor is a link, ``rotor_0`` and on.
    """
    links = {link.attributes.get("name"): link for link in model.links}
    places = [
        model.pose_of(links[name]).position - rotor.position
        for index, rotor in enumerate(vehicle.rotors)
        if (name := f"rotor_{index}") in links
    ]
    return np.mean(places, axis=0) if len(places) == len(vehicle.rotors) else None


def as_text(value: float) -> str:
    """Return a number as text of at most twelve digits."""
    return format(value, ".12g")


# the tags alone


def sdf_or_snippet(
    vehicle: VehicleFile, provenance: str, simulator: Simulator, into: Path | None
) -> Draft:
    """Return a model with a vehicle's numbers, or the tags alone.

    These are inertial, motor plugins and, for Gazebo classic, control channels.
    """
    if into is not None:
        return sdf_draft(into, vehicle, provenance)
    flown = simulator.flown(vehicle)
    scaled = laws.with_speed_unit(flown, laws.gz_speed_unit(flown) if simulator is GZ_SIM else 1.0)
    wanted = numbers_of(scaled, channels=simulator is not GZ_SIM)

    def faults(path: Path, _: object) -> list[str]:
        text = f"<model><link name='base_link'>{read_file(path)}</link></model>"
        model = sdf_of(parse(text, path), len(scaled.rotors))
        return differences(wanted, read_values(model, scaled))

    return Draft(_snippet(scaled, simulator, provenance), flown, _deviations(vehicle), faults)


def _deviations(vehicle: VehicleFile) -> tuple[str, ...]:
    """Return clauses on properties of a vehicle that the plugins fly differently."""
    if vehicle.aerodynamics.reaction_torque == "body":
        return ()
    return ("the plugins' reaction torque acts about the body's z axis, not the world's",)


def _snippet(vehicle: VehicleFile, simulator: Simulator, provenance: str) -> str:
    environment = Environment(
        undefined=StrictUndefined, keep_trailing_newline=True, autoescape=True
    )
    numbers = {name: as_text(value) for name, value in numbers_of(vehicle).items()}
    return environment.from_string(TEMPLATE.read_text(encoding="utf-8")).render(
        provenance=xml_comment(provenance),
        simulator=simulator.name,
        numbers=numbers,
        rotors=vehicle.rotors,
        motor_tags=[motor_tags(vehicle, index) for index in range(len(vehicle.rotors))],
        channel_tags=channel_tags(),
        center_of_mass=" ".join(map(as_text, center_of_mass(vehicle).values())),
    )


# a patched model


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
    model = read_sdf(path, rotors, prepare=lambda text, _: without_jinja(text))
    whole = read_sdf(path, rotors)
    flown = (GZ_SIM if whole.is_gz else GAZEBO_CLASSIC).flown(vehicle)
    unit = laws.gz_speed_unit(flown) if whole.is_gz else 1.0
    scaled = laws.with_speed_unit(flown, unit)
    wanted = numbers_of(scaled, channels=bool(whole.channels()))
    base = _base_body(whole, scaled)
    edits = [*_edits(model, whole, scaled, base)]
    edits = [*dict.fromkeys(map(_edit_of_variable, edits))]
    places = [(edit.source, edit.start, edit.end) for edit in edits if edit.end > edit.start]
    if len(set(places)) < len(places):
        raise ExportError(
            path,
            "sets the motorConstant of all rotors at once, and this vehicle's differ",
            "give each rotor's plugin a number of its own",
        )
    patched = _patched(model, edits, provenance)
    final = read_sdf(path, rotors, texts=patched)
    if wrong := differences(wanted, read_values(final, scaled)):
        raise ExportError(path, f"would come out with {'; '.join(wrong)}", "nothing was written")

    def faults(file: Path, instead: Mapping[Path, Path]) -> list[str]:
        texts = {at: read_file(written) for at, written in {**instead, path: file}.items()}
        return differences(wanted, read_values(read_sdf(path, rotors, texts=texts), scaled))

    there, geometry = _rotors_there(final, flown)
    return Draft(
        patched.pop(path, model.root.source.raw),
        there,
        tuple(_notes(whole, vehicle, scaled, base, unit)),
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
    return (GZ_SIM if read_sdf(path, MAX_ROTORS).is_gz else GAZEBO_CLASSIC).name


def _patched(model: SdfModel, edits: Sequence[Edit], provenance: str) -> dict[Path, str]:
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


def _base_body(model: SdfModel, vehicle: VehicleFile) -> Inertial:
    """Return the base link's body with which the model has the vehicle's mass and inertia.

    It moves only if the centre of mass is not the origin of rotor positions.
    """
    others = [body for link, body in inertials(model) if link is not model.base]
    inertia, offset, centre = vehicle.inertia, center_of_mass(vehicle), None
    if offset:
        origin = rotor_origin(model, vehicle)
        if origin is None:
            raise ExportError(
                model.path,
                "shows no places of rotors to put the centre of mass against",
                f"call their links rotor_0 to rotor_{len(vehicle.rotors) - 1}",
            )
        centre = origin + np.array([*offset.values()])
    try:
        return base_for(
            vehicle.mass,
            np.diag([inertia.xx, inertia.yy, inertia.zz]),
            model.pose_of_inertial(model.base),
            others,
            centre=centre,
        )
    except ValueError as error:
        what, remedy = str(error), "lighten those links, or give another model"
        if more := _more_rotors(model, vehicle):
            what, remedy = f"is of another vehicle: {more}", "give a model of this one"
        raise ExportError(model.path, what, remedy) from None


def _edits(
    model: SdfModel, whole: SdfModel, vehicle: VehicleFile, base: Inertial
) -> Iterator[Edit]:
    """Yield the edits that put a vehicle's numbers into a model.

    ``model`` is the text to edit, ``whole`` the rendered model.
    """
    inertial = model.base.find("inertial")
    tensor = inertial.find("inertia") if inertial else None
    if inertial is None or tensor is None or tensor.content == tensor.end:  # <inertia/>
        raise ExportError(
            model.path,
            f"base link '{model.base.attributes.get('name')}' has no <inertial> with <inertia>",
            "give it one, its numbers do not matter",
        )
    yield from _value_edits(inertial, {"mass": as_text(base.mass)})
    smallest = MAX_ZERO_PRODUCT * np.trace(base.inertia)
    for row, column in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)):
        tag, value = f"i{'xyz'[row]}{'xyz'[column]}", base.inertia[row, column]
        none = abs(value) < smallest and row != column
        if not none or tensor.find(tag) is not None:
            yield from _value_edits(tensor, {tag: as_text(0.0 if none else value)})
    numbers = {name: as_text(value) for name, value in numbers_of(vehicle).items()}
    if rotor_constants(vehicle) and None in map(motor_number, model.motors()):
        raise ExportError(
            model.path,
            "draws its rotors from a template, and this vehicle's differ in motor_constant",
            "give each rotor a plugin of its own",
        )
    for element, tags in _tagged(model, vehicle):
        yield from _value_edits(element, {tag: numbers[name] for tag, name in tags.items()})
    if center_of_mass(vehicle):  # with all digits: it is the small difference of large numbers
        link, pose = whole.pose_of(whole.base), inertial.find("pose")
        place = (link.rotation.T @ (base.pose.position - link.position)).tolist()
        angles = (pose.value.split()[3:] if pose else []) or ["0", "0", "0"]
        yield from _value_edits(inertial, {"pose": " ".join([*map(repr, place), *angles])})


def _value_edits(parent: Element, values: Mapping[str, str]) -> Iterator[Edit]:
    """Yield the edits that set the values of children, without those that are equal already."""
    for tag, value in values.items():
        child = parent.find(tag)
        if child is None:
            yield spans.append_child(parent, tag, value)
        elif value != (child.value if child.number is None else as_text(child.number)):
            yield spans.set_value(child, value)


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
    model: SdfModel, asked: VehicleFile, vehicle: VehicleFile, base: Inertial, unit: float
) -> Iterator[str]:
    """Yield remarks on the patched model, and on properties that the format lacks."""
    name = model.base.attributes.get("name", "")
    others = [(link, body) for link, body in inertials(model) if link is not model.base]
    if others:
        names = ", ".join(link.attributes.get("name", "") for link, _ in others)
        yield (
            f"the vehicle's {as_text(vehicle.mass)} kg and inertia are those of all links "
            f"together: '{name}' gets {as_text(base.mass)} kg and what inertia {names} leave"
        )
    if model.included:
        yield f"the mass of what the model includes is not counted: {', '.join(model.included)}"
    if model.is_gz:
        low, high = (laws.rotor_speed(vehicle, command) for command in (0.0, 1.0))
        last = len(vehicle.rotors)
        yield (
            "gz-sim has no control channels, PX4's parameters map commands: set "
            f"SIM_GZ_EC_MIN1..{last} to {low:.0f} and SIM_GZ_EC_MAX1..{last} to {high:.0f}, as "
            "--format px4 --simulator gz-sim does"
        )
    if unit < 1:
        scaled = laws.scaling_in_words(laws.rotor_speed(vehicle, 1.0) / unit)
        yield (
            f"{scaled} and motorConstant and rotorDragCoefficient to match, which moves nothing "
            "otherwise"
        )
    if center_of_mass(vehicle):
        place = ", ".join(as_text(round(number, 9)) for number in base.pose.position)
        yield f"the inertial of '{name}' moves to ({place}) m for the vehicle's centre of mass"
    yield from _deviations(asked)


def _more_rotors(model: SdfModel, vehicle: VehicleFile) -> str:
    """Return a clause if a model has more rotors than a vehicle; else an empty text."""
    count, own = len(replace(model, rotors=MAX_ROTORS).rotor_links()), len(vehicle.rotors)
    return f"the model has {count} rotors, the vehicle {own}" if count > own else ""


def _rotors_there(model: SdfModel, vehicle: VehicleFile) -> tuple[VehicleFile, tuple[str, ...]]:
    """Return a vehicle with a model's rotors, and a clause for each difference of its own."""
    more = _more_rotors(model, vehicle)
    clauses, rotors = [more] if more else [], list(vehicle.rotors)
    driven = Counter(map(motor_number, model.motors()))
    clauses += [
        f"rotor_{index} has {driven[index] or 'no'} motor plugins"
        for index in range(len(rotors))
        if driven[index] != 1 and None not in driven
    ]
    centre = composite(model).pose.position
    offset = np.array([*center_of_mass(vehicle).values()] or [0.0] * 3)
    for index, (link, turns) in sorted(model.rotor_links().items()):
        rotor, place = rotors[index], model.pose_of(link).position - centre
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

"""SDF of Gazebo classic or gz-sim: a patched model, or the tags alone."""

from __future__ import annotations

from pathlib import Path

from jinja2 import Environment, StrictUndefined

from tuner.exporters.sdf import tags
from tuner.exporters.sdf.patch import sdf_draft, simulator_of
from tuner.exporters.sdf.spans import parse
from tuner.exporters.sdf.tags import read_values
from tuner.exporters.simulators import (
    GAZEBO_CLASSIC,
    GZ_SIM,
    Simulator,
    gz_speed_unit,
    with_speed_unit,
)
from tuner.exporters.target import Draft, Target, differences, read_file, xml_comment
from tuner.vehicle import VehicleFile

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
        model = f"<model><link name='base_link'>{text}</link></model>"
        return read_values(parse(model, path), vehicle)

    notes = tags.plugin_deviations(vehicle)
    vehicle = simulator.flown(vehicle)
    unit = gz_speed_unit(vehicle) if simulator is GZ_SIM else 1.0
    vehicle = with_speed_unit(vehicle, unit)
    wanted = tags.carried_values(vehicle, channels=simulator is not GZ_SIM)
    text = _text(vehicle, simulator, provenance)
    return Draft(
        text,
        with_speed_unit(
            tags.with_model_values(vehicle, wanted | held_by(text, TEMPLATE)), 1.0 / unit
        ),
        notes,
        lambda path, _: differences(wanted, held_by(read_file(path), path)),
    )


def _text(vehicle: VehicleFile, simulator: Simulator, provenance: str) -> str:
    environment = Environment(
        undefined=StrictUndefined, keep_trailing_newline=True, autoescape=True
    )
    inertia, uneven, centre = (
        vehicle.inertia,
        tags.motor_constants(vehicle),
        tags.center_of_mass(vehicle),
    )
    motor = {tag: tags.as_text(value) for tag, value in tags.tag_values(vehicle, "motor").items()}
    motors = [
        motor
        if uneven is None
        else motor | {tags.MOTOR_CONSTANT: tags.as_text(uneven[tags.rotor_constant_name(index)])}
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


TARGET = Target(
    "sdf",
    ".sdf",
    sdf_or_snippet,
    simulator=GAZEBO_CLASSIC,
    others=(GZ_SIM,),
    simulator_of=simulator_of,
)

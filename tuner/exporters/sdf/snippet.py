"""The tags alone, for a reader to paste into a model by hand."""

from __future__ import annotations

from pathlib import Path

from jinja2 import Environment, StrictUndefined

from tuner.config import VehicleFile
from tuner.exporters.draft import Draft, differences, read_file
from tuner.exporters.sdf.read_back import values_in
from tuner.exporters.sdf.tags import (
    MOTOR_CONSTANT,
    as_flown,
    as_text,
    carried_values,
    center_of_mass,
    lost_in,
    motor_constants,
    of_rotor,
    values,
)
from tuner.exporters.target import Simulator

TEMPLATE = Path(__file__).parent / "snippet.sdf.jinja"


def snippet_draft(vehicle: VehicleFile, simulator: Simulator, provenance: str) -> Draft:
    """Return inertial, motor plugins and, for Gazebo classic, control channels of a vehicle.

    Parameters
    ----------
    vehicle
        Whose coefficients.
    simulator
        Whose plugins.
    provenance
        One line that says where they come from.
    """

    def held_by(text: str, path: Path) -> dict[str, float]:
        model = f"<model><link name='base_link'>{text}</link></model>"
        return values_in(model, path, vehicle)

    wanted = carried_values(vehicle, channels=simulator == "gazebo-classic")
    text = _text(vehicle, simulator, provenance)
    return Draft(
        text,
        as_flown(vehicle, wanted | held_by(text, TEMPLATE)),
        lost_in(vehicle),
        lambda path: differences(wanted, held_by(read_file(path), path)),
    )


def _text(vehicle: VehicleFile, simulator: Simulator, provenance: str) -> str:
    environment = Environment(
        undefined=StrictUndefined, keep_trailing_newline=True, autoescape=True
    )
    inertia, uneven, centre = vehicle.inertia, motor_constants(vehicle), center_of_mass(vehicle)
    motor = {tag: as_text(value) for tag, value in values(vehicle, "motor").items()}
    motors = [
        motor if uneven is None else motor | {MOTOR_CONSTANT: as_text(uneven[of_rotor(index)])}
        for index in range(len(vehicle.rotors))
    ]
    return environment.from_string(TEMPLATE.read_text(encoding="utf-8")).render(
        provenance=provenance.replace("--", "- -"),
        simulator=simulator,
        mass=as_text(vehicle.mass),
        ixx=as_text(inertia.xx),
        iyy=as_text(inertia.yy),
        izz=as_text(inertia.zz),
        center_of_mass=None if centre is None else " ".join(map(as_text, centre)),
        rotors=list(zip(vehicle.rotors, motors, strict=True)),
        channel={tag: as_text(value) for tag, value in values(vehicle, "channel").items()},
    )

"""The tags alone, for a reader to paste into a model by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from jinja2 import Environment, StrictUndefined

from tuner.config import VehicleFile
from tuner.export.draft import Draft, differences, read_file
from tuner.export.sdf.read_back import vehicle_in
from tuner.export.sdf.tags import CHANNEL_TAGS, MOTOR_TAGS, as_flown, as_text, lost_in, values

Simulator = Literal["gazebo-classic", "gz-sim"]
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

    def found_in(text: str, path: Path) -> VehicleFile:
        model = f"<model><link name='base_link'>{text}</link></model>"
        return vehicle_in(model, path, vehicle)

    text = _text(vehicle, simulator, provenance)
    return Draft(
        text,
        found_in(text, TEMPLATE),
        lost_in(vehicle),
        lambda path: differences(as_flown(vehicle), found_in(read_file(path), path)),
    )


def _text(vehicle: VehicleFile, simulator: Simulator, provenance: str) -> str:
    environment = Environment(
        undefined=StrictUndefined, keep_trailing_newline=True, autoescape=True
    )
    inertia = vehicle.inertia
    return environment.from_string(TEMPLATE.read_text(encoding="utf-8")).render(
        provenance=provenance.replace("--", "- -"),
        simulator=simulator,
        mass=as_text(vehicle.mass),
        ixx=as_text(inertia.xx),
        iyy=as_text(inertia.yy),
        izz=as_text(inertia.zz),
        rotors=vehicle.rotors,
        motor={tag: as_text(value) for tag, value in values(vehicle, MOTOR_TAGS).items()},
        channel={tag: as_text(value) for tag, value in values(vehicle, CHANNEL_TAGS).items()},
    )

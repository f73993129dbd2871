"""JSON of a vehicle for other simulators: all numbers with units, thrust and hover."""

from __future__ import annotations

import json

from tuner.exporters import laws
from tuner.exporters.target import Target, numbers_draft, read_file
from tuner.vehicle import COEFFICIENTS, VehicleFile, values_of


def coefficients(vehicle: VehicleFile) -> dict[str, float]:
    """Return name -> number of a vehicle."""
    return values_of(vehicle) | {"max_rotor_velocity": vehicle.motor.max_rotor_velocity}


def json_text(vehicle: VehicleFile, provenance: str) -> str:
    """Return coefficients with units, rotors (forward, left, up; m), and thrust and hover."""
    values = coefficients(vehicle)
    content = {
        "name": vehicle.name,
        "provenance": provenance,
        "frame": "body: x forward, y left, z up; spin seen from above",
        "coefficients": values,
        "units": {
            name: COEFFICIENTS[name].unit if name in COEFFICIENTS else "rad/s" for name in values
        },
        "meanings": {name: COEFFICIENTS[name].meaning for name in values if name in COEFFICIENTS},
        "rotors": [rotor.model_dump(mode="json") for rotor in vehicle.rotors],
        "derived": {
            "full_thrust_of_one_rotor_N": laws.full_thrust(vehicle),
            "thrust_to_weight": laws.thrust_to_weight(vehicle),
            "hover_rotor_speed_rad_s": laws.hover_speed(vehicle),
            "hover_command": laws.hover_command(vehicle),
        },
    }

    return json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


TARGET = Target(
    "json",
    ".json",
    numbers_draft(
        coefficients, json_text, lambda path: json.loads(read_file(path))["coefficients"]
    ),
)

"""The vehicle file of a run, with source and confidence of each coefficient."""

from __future__ import annotations

from pathlib import Path

from tuner.exporters.target import Draft, Target
from tuner.vehicle import VehicleFile, read_vehicle, vehicle_text


def yaml_draft(vehicle: VehicleFile, provenance: str, *_: object) -> Draft:
    """Return a vehicle file that ``tune --vehicle`` reads."""

    def faults(path: Path, _: object) -> list[str]:
        return [] if read_vehicle(path) == vehicle else ["it holds another vehicle"]

    return Draft(vehicle_text(vehicle, header=provenance), vehicle, (), faults)


TARGET = Target("yaml", ".yaml", yaml_draft)

"""A vehicle out to a file, with the unit beside each coefficient."""

from __future__ import annotations

from pathlib import Path

from tuner.coefficients import COEFFICIENTS
from tuner.config.vehicle import VehicleFile
from tuner.disk import write_text
from tuner.yaml_files.document import commented, dump_yaml

UNIT_COLUMN = 44


def write_vehicle(vehicle: VehicleFile, path: str | Path, *, header: str = "") -> None:
    """Write a vehicle file that `read_vehicle` reads back to an equal vehicle.

    Parameters
    ----------
    vehicle
        What to write.
    path
        The file to make or replace; it appears whole.
    header
        Comment lines for the top of the file.

    Raises
    ------
    ConfigError
        The file cannot be written.
    """
    write_text(Path(path), vehicle_text(vehicle, header=header))


def vehicle_text(vehicle: VehicleFile, *, header: str = "") -> str:
    """Return the text of a vehicle file, as `write_vehicle` writes it."""
    data = vehicle.model_dump(mode="json", exclude_none=True)
    for section in ("battery", "effects", "source"):
        if not data[section]:
            del data[section]
    return commented(header) + _with_units(dump_yaml(data))


#: Of numbers that are not fitted.
_OTHER_UNITS = {
    ("", "rotors"): "positions in m from the centre of mass: forward, left, up",
    ("motor", "max_rotor_velocity"): "rad/s",
    ("battery", "reference_voltage"): "V",
}


def _with_units(text: str) -> str:
    """Put a number's unit behind its line."""
    units = {coefficient.place: coefficient.unit for coefficient in COEFFICIENTS.values()}
    units |= _OTHER_UNITS
    section = ""
    lines = []
    for line in text.splitlines():
        key = line.partition(":")[0]
        inside = line.startswith("  ")
        if not inside:
            section = key
        unit = units.get((section if inside else "", key.strip()))
        lines.append(f"{line + '  ':<{UNIT_COLUMN}}# {unit}" if unit else line)
    return "\n".join(lines) + "\n"

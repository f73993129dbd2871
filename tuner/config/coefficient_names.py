"""The coefficients' names and units, and where each one lives in a vehicle file."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from tuner.config.model import build
from tuner.config.vehicle import VehicleFile
from tuner.errors import ConfigError, did_you_mean


@dataclass(frozen=True)
class Coefficient:
    """A number that a fit can move.

    Attributes
    ----------
    unit
        For tables.
    place
        Section and key in the vehicle file; no section for the mass.
    meaning
        One line for people.
    """

    unit: str
    place: tuple[str, str]
    meaning: str


COEFFICIENTS: Mapping[str, Coefficient] = {
    "mass": Coefficient("kg", ("", "mass"), "take-off mass"),
    "inertia_xx": Coefficient("kg m²", ("inertia", "xx"), "moment of inertia about forward"),
    "inertia_yy": Coefficient("kg m²", ("inertia", "yy"), "moment of inertia about left"),
    "inertia_zz": Coefficient("kg m²", ("inertia", "zz"), "moment of inertia about up"),
    "input_scaling": Coefficient(
        "rad/s", ("motor", "input_scaling"), "rotor speed gained from no command to full"
    ),
    "zero_position_armed": Coefficient(
        "rad/s", ("motor", "zero_position_armed"), "rotor speed at zero command"
    ),
    "input_offset": Coefficient("", ("motor", "input_offset"), "added to the command"),
    "quadratic": Coefficient(
        "rad/s", ("motor", "quadratic"), "rotor speed per squared unit of command"
    ),
    "time_constant_up": Coefficient(
        "s", ("motor", "time_constant_up"), "lag of a rotor that speeds up"
    ),
    "time_constant_down": Coefficient(
        "s", ("motor", "time_constant_down"), "lag of a rotor that slows down"
    ),
    "motor_constant": Coefficient(
        "N s²/rad²", ("aerodynamics", "motor_constant"), "thrust per squared rotor speed"
    ),
    "moment_constant": Coefficient(
        "m", ("aerodynamics", "moment_constant"), "drag torque per thrust"
    ),
    "rotor_drag_coefficient": Coefficient(
        "N s²/(rad m)",
        ("aerodynamics", "rotor_drag_coefficient"),
        "drag in the rotor plane per rotor speed and air velocity",
    ),
    "rolling_moment_coefficient": Coefficient(
        "N s²/rad",
        ("aerodynamics", "rolling_moment_coefficient"),
        "moment in the rotor plane per rotor speed and air velocity",
    ),
    "max_relative_airspeed": Coefficient(
        "m/s", ("aerodynamics", "max_relative_airspeed"), "axial airspeed at which thrust vanishes"
    ),
    "estimate_latency": Coefficient(
        "s", ("setup", "estimate_latency"), "age of the state that the controllers see"
    ),
    "actuator_latency": Coefficient(
        "s", ("setup", "actuator_latency"), "from a motor command to its effect"
    ),
    "gyro_cutoff": Coefficient("Hz", ("setup", "gyro_cutoff"), "low-pass filter of the gyro"),
}


def check_names(names: Iterable[str], where: str) -> None:
    """Refuse names that are no coefficient's.

    Raises
    ------
    ConfigError
        Names the first unknown one and the nearest known.
    """
    for name in names:
        if name not in COEFFICIENTS:
            raise ConfigError(
                where, f"unknown coefficient '{name}'", did_you_mean(name, COEFFICIENTS)
            )


def values_of(vehicle: VehicleFile) -> dict[str, float]:
    """Return coefficient name to value, without those that the vehicle file leaves open."""
    values = {}
    for name, coefficient in COEFFICIENTS.items():
        section, key = coefficient.place
        value = getattr(getattr(vehicle, section) if section else vehicle, key)
        if value is not None:
            values[name] = float(value)
    return values


def with_values(vehicle: VehicleFile, values: Mapping[str, float]) -> VehicleFile:
    """Return the vehicle with some coefficients changed.

    Raises
    ------
    ConfigError
        A name is unknown, or the values make no vehicle (a negative mass, an impossible inertia).
    """
    check_names(values, vehicle.name)
    data = vehicle.model_dump()
    for name, value in values.items():
        section, key = COEFFICIENTS[name].place
        (data[section] if section else data)[key] = float(value)
    return build(VehicleFile, data, vehicle.name)

"""Coefficient values out of vehicle and controller files, and into vehicle files."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from tuner.core.errors import ConfigError, did_you_mean
from tuner.core.yaml_section import build
from tuner.vehicle import COEFFICIENTS
from tuner.vehicle.controller import ControllerFile
from tuner.vehicle.vehicle import VehicleFile


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
        value = (
            vehicle.effects.get(name)
            if coefficient.is_effect
            else getattr(getattr(vehicle, section) if section else vehicle, key)
        )
        if value is not None:
            values[name] = float(value)
    return values


def initial_values(
    vehicle: VehicleFile, controller: ControllerFile, free: Iterable[str] = ()
) -> dict[str, float]:
    """Return the value of every coefficient that flies before a fit has moved any.

    Parameters
    ----------
    vehicle, controller
        What flies; the controller file holds where the vehicle file leaves a coefficient open.
    free
        Coefficients that a fit moves: of terms that the vehicle file leaves out, these act too,
        from their neutral values on.

    Returns
    -------
    dict
        Name -> value in the coefficient's unit, in the registry's order. A coefficient of something
        that does not fly, as the cutoff of a filter that is left out, is not in it.
    """
    given, wanted, values = values_of(vehicle), set(free), {}
    for name, coefficient in COEFFICIENTS.items():
        value = given.get(name)
        if value is None and coefficient.fallback is not None:
            section, key = coefficient.fallback
            value = getattr(getattr(controller, section), key)
        if value is None and name in wanted:
            value = coefficient.neutral
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

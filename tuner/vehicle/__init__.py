"""The registry of coefficients, the files that hold their values, and the model made of them."""

from __future__ import annotations

from tuner.vehicle.coefficient import EFFECTS, Coefficient, ExportTag, NoExportTag
from tuner.vehicle.controller import ControllerFile, read_controller
from tuner.vehicle.registry import (
    COEFFICIENTS,
    REGISTRY,
    condition_rows,
    of_scope,
    recording_offsets,
    scale_group,
    term_groups,
)
from tuner.vehicle.vehicle import (
    VehicleFile,
    check_filter,
    check_names,
    check_rotors,
    check_value,
    initial_values,
    read_vehicle,
    values_of,
    vehicle_text,
    with_values,
    write_vehicle,
)

__all__ = [
    "COEFFICIENTS",
    "EFFECTS",
    "REGISTRY",
    "Coefficient",
    "ControllerFile",
    "ExportTag",
    "NoExportTag",
    "VehicleFile",
    "check_filter",
    "check_names",
    "check_rotors",
    "check_value",
    "condition_rows",
    "initial_values",
    "of_scope",
    "read_controller",
    "read_vehicle",
    "recording_offsets",
    "scale_group",
    "term_groups",
    "values_of",
    "vehicle_text",
    "with_values",
    "write_vehicle",
]

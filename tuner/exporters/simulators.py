"""Descriptions of simulators: what of a vehicle they have, and what they compute otherwise.

A simulator differs from the fitted physics by coefficients with a built-in value
(`Simulator.entry`) and by its laws (`Simulator.laws`). Both give a vehicle with which the project's
own simulation flies like that simulator. Those of one export target stand in its module.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import reduce
from types import MappingProxyType

from tuner.exporters.laws import with_body_torque, with_effects, with_whole_speeds
from tuner.vehicle import (
    COEFFICIENTS,
    REGISTRY,
    Coefficient,
    ExportTag,
    NoExportTag,
    VehicleFile,
    values_of,
    with_values,
)
from tuner.vehicle.registry import NO_LOSS

Entry = ExportTag | NoExportTag
Law = Callable[[VehicleFile], VehicleFile]

_SETUP_ENTRY = NoExportTag("it belongs to the set-up, not to the vehicle")


@dataclass(frozen=True)
class Simulator:
    """A simulator that vehicles are exported for.

    Attributes
    ----------
    name, title
        Its name on the command line, and in sentences; this project's has no name.
    version, source
        Of the code or documentation that says what it computes.
    deviations
        Its differences from the fitted physics, a clause each.
    entry
        A coefficient's place in its file, or why it has none and which value is built in.
    laws
        A vehicle -> the one by each law in turn, for differences without a coefficient. Idempotent.
    free
        Effective coefficients beside those of Gazebo's motor model.
    ties
        Groups of coefficients that are one in it.
    fixed
        Coefficients that are not fitted for it, as redundant or indeterminate there.
    start
        A vehicle -> the start of a fit of effective coefficients; None starts as `flown`.
    """

    name: str
    title: str
    version: str
    source: str
    deviations: tuple[str, ...]
    entry: Callable[[Coefficient], Entry | None]
    laws: tuple[Law, ...] = (with_body_torque,)
    free: tuple[str, ...] = ()
    ties: tuple[tuple[str, ...], ...] = ()
    fixed: tuple[str, ...] = ()
    start: Law | None = None

    def lawful(self, vehicle: VehicleFile) -> VehicleFile:
        """Return the vehicle by its laws."""
        return reduce(lambda changed, law: law(changed), self.laws, vehicle)

    def flown(self, vehicle: VehicleFile) -> VehicleFile:
        """Return the vehicle with which this project flies like the simulator."""
        vehicle = self.lawful(vehicle)
        return self.with_built_in(
            vehicle, [n for n in values_of(vehicle) if self.built_in(n) is not None]
        )

    def built_in(self, name: str) -> float | None:
        """Return its built-in value of a coefficient; None if it has the coefficient."""
        entry = self.entry(REGISTRY[name])
        return entry.built_in if isinstance(entry, NoExportTag) else None

    def lost(self, acting: Mapping[str, float]) -> dict[str, tuple[str, ...]]:
        """Return group -> its coefficients whose built-in value differs from the given one."""
        groups: dict[str, tuple[str, ...]] = {}
        for name, value in acting.items():
            if self.built_in(name) not in (None, value):
                row = REGISTRY[name]
                group = row.group if row.group and row.by_law is None else name
                groups[group] = (*groups.get(group, ()), name)
        return groups

    def with_built_in(self, vehicle: VehicleFile, names: Collection[str]) -> VehicleFile:
        """Return a vehicle with built-in values of some coefficients."""
        built_in = {
            name: value
            for name in names
            if name in COEFFICIENTS and not COEFFICIENTS[name].is_effect
            if (value := self.built_in(name)) is not None
        }
        return with_values(with_effects(vehicle, names), built_in)


def registry_entries(
    target: str, other: Mapping[str, NoExportTag] = MappingProxyType({})
) -> Callable[..., Entry | None]:
    """Return the `Simulator.entry` of a target in the registry, with exceptions."""
    return lambda row: other.get(row.name) or row.exported_as.get(target)


GAZEBO_CLASSIC = Simulator(
    name="gazebo-classic",
    title="Gazebo",
    version="PX4-SITL_gazebo-classic 807b67bb",
    source="src/gazebo_motor_model.cpp, include/gazebo_mavlink_interface.h",
    deviations=("thrust falls by the length of the axial airspeed over 25 m/s",),
    entry=registry_entries("sdf"),
)
GZ_SIM = Simulator(
    name="gz-sim",
    title="gz-sim",
    version="gz-sim 9 (061b93b1), PX4 1.15 to 1.17",
    source="src/systems/multicopter_motor_model/MulticopterMotorModel.cc; "
    "PX4 src/modules/simulation/gz_bridge/module.yaml",
    deviations=(
        "thrust does not depend on the airspeed",
        "rolling moments add up whichever way rotors turn: none is written",
        "commands are mapped by a line from SIM_GZ_EC_MIN to SIM_GZ_EC_MAX, whole rad/s up to 1000",
    ),
    entry=registry_entries(
        "sdf",
        {
            "max_relative_airspeed": NoExportTag(
                "thrust in gz-sim does not depend on the airspeed", NO_LOSS
            ),
            "rolling_moment_coefficient": NoExportTag(
                "gz-sim adds rolling moments up whichever way rotors turn, so that 0 is written",
                0.0,
            ),
        },
    ),
    laws=(with_whole_speeds,),
)
MOTORS = ("input_scaling", "zero_position_armed", "input_offset", "quadratic")
_NOT_MODELLED = {
    "rolling_moment_coefficient": NoExportTag("it has no such term", 0.0),
    "max_relative_airspeed": NoExportTag("its thrust does not depend on the airspeed", NO_LOSS),
}
"""Coefficients of Gazebo's motor model that the others lack, and why."""
_BODY = ("mass", "inertia_xx", "inertia_yy", "inertia_zz")


def entries(title: str, *groups: tuple[str, ...], **keys: str) -> Callable[..., Entry]:
    """Return `Simulator.entry` of a simulator from its coefficients.

    Parameters
    ----------
    groups, keys
        Coefficients with their own names, beside body and motors, and coefficient -> key.
    """
    held = {name: name for group in (_BODY, MOTORS, *groups) for name in group} | keys

    def entry(row: Coefficient) -> Entry:
        if row.name in held:
            return ExportTag(held[row.name])
        if row.name in _NOT_MODELLED:
            return _NOT_MODELLED[row.name]
        if row.scope != "vehicle":
            return _SETUP_ENTRY
        return NoExportTag(f"{title} has no such term", row.neutral)

    return entry


THIS_PROJECT = Simulator(
    name="",
    title="this project",
    version="",
    source="sim_jax",
    deviations=(),
    entry=lambda row: ExportTag(".".join(row.place)),
    laws=(),
)

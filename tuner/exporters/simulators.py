"""Rotor speed and thrust, descriptions of simulators, and laws that several of them share.

A simulator differs from the fitted physics by coefficients with a built-in value
(`Simulator.entry`) and by its laws (`Simulator.laws`). Both give a vehicle with which the project's
own simulation flies like that simulator. Those of one export target stand in its module.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from statistics import fmean
from types import MappingProxyType

from sim_jax.constants import GRAVITY
from tuner.core.errors import ExportError
from tuner.vehicle import (
    COEFFICIENTS,
    REGISTRY,
    Coefficient,
    NotCarried,
    VehicleFile,
    Written,
    values_of,
    with_values,
)
from tuner.vehicle.registry import NO_LOSS


def rotor_speed(vehicle: VehicleFile, command: float) -> float:
    """Return the steady rotor speed in rad/s at a command 0..1."""
    motor = vehicle.motor
    shifted = command + motor.input_offset
    speed = shifted * (motor.input_scaling + motor.quadratic * shifted) + motor.zero_position_armed
    return min(speed, motor.max_rotor_velocity)


def thrust_at(vehicle: VehicleFile, speed: float) -> float:
    """Return one rotor's thrust in N at a rotor speed in rad/s, in still air."""
    aerodynamics = vehicle.aerodynamics
    return aerodynamics.motor_constant * (
        speed if aerodynamics.thrust_law == "linear" else speed * speed
    )


def full_thrust(vehicle: VehicleFile) -> float:
    """Return one rotor's thrust in N at full command."""
    return thrust_at(vehicle, rotor_speed(vehicle, 1.0))


def thrust_to_weight(vehicle: VehicleFile) -> float:
    """Return the thrust of all rotors at full command over the weight."""
    return len(vehicle.rotors) * full_thrust(vehicle) / (vehicle.mass * GRAVITY)


def hover_speed(vehicle: VehicleFile) -> float:
    """Return the rotor speed in rad/s of the hover."""
    aerodynamics = vehicle.aerodynamics
    squared = vehicle.mass * GRAVITY / len(vehicle.rotors) / aerodynamics.motor_constant
    return squared if aerodynamics.thrust_law == "linear" else math.sqrt(squared)


def hover_command(vehicle: VehicleFile) -> float | None:
    """Return the command 0..1 of the hover; None if full command is too weak."""
    wanted = hover_speed(vehicle)
    low, high = 0.0, 1.0
    if not rotor_speed(vehicle, low) < wanted < rotor_speed(vehicle, high):
        return None
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if rotor_speed(vehicle, middle) < wanted else (low, middle)
    return 0.5 * (low + high)


Entry = Written | NotCarried
Laws = Callable[[VehicleFile], VehicleFile]

_SETUP_ENTRY = NotCarried("it belongs to the set-up, not to the vehicle")


def with_body_torque(vehicle: VehicleFile) -> VehicleFile:
    """Return a vehicle whose rotors' reaction torque acts about the body's z axis."""
    return vehicle.replace(aerodynamics=vehicle.aerodynamics.replace(reaction_torque="body"))


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
        A vehicle -> the one by its laws, for differences without a coefficient. Idempotent.
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
    laws: Laws = with_body_torque
    free: tuple[str, ...] = ()
    ties: tuple[tuple[str, ...], ...] = ()
    fixed: tuple[str, ...] = ()
    start: Laws | None = None

    def flown(self, vehicle: VehicleFile) -> VehicleFile:
        """Return the vehicle with which this project flies like the simulator."""
        vehicle = self.laws(vehicle)
        return self.with_built_in(
            vehicle, [n for n in values_of(vehicle) if self.built_in(n) is not None]
        )

    def built_in(self, name: str) -> float | None:
        """Return its built-in value of a coefficient; None if it has the coefficient."""
        entry = self.entry(REGISTRY[name])
        return entry.built_in if isinstance(entry, NotCarried) else None

    def lost(self, acting: Mapping[str, float]) -> dict[str, tuple[str, ...]]:
        """Return group -> its coefficients whose built-in value differs from the given one."""
        groups: dict[str, tuple[str, ...]] = {}
        for name, value in acting.items():
            if self.built_in(name) not in (None, value):
                group = REGISTRY[name].group or name
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


def with_effects(
    vehicle: VehicleFile,
    without: Collection[str],
    effects: Mapping[str, float] = MappingProxyType({}),
) -> VehicleFile:
    """Return a vehicle without some effects, and with others."""
    left = {name: value for name, value in vehicle.effects.items() if name not in without}
    return vehicle.replace(effects={**left, **effects})


# laws


def with_mean_lag(vehicle: VehicleFile) -> VehicleFile:
    """Return a vehicle with the mean lag for rotors that speed up or slow down."""
    motor = vehicle.motor
    lag = fmean((motor.time_constant_up, motor.time_constant_down))
    return vehicle.replace(motor=motor.replace(time_constant_up=lag, time_constant_down=lag))


def drag_at_hover(vehicle: VehicleFile) -> tuple[float, float, float]:
    """Return the linear drag along x, y and z in N s/m at the hover's rotor speed.

    It is that of rotors and body; along z it has the change of thrust with the inflow.
    """
    count, speed, effects = len(vehicle.rotors), hover_speed(vehicle), vehicle.effects
    rotors = count * speed * vehicle.aerodynamics.rotor_drag_coefficient
    body = [effects.get(f"linear_drag_{axis}", 0.0) for axis in "xyz"]
    inflow = count * speed * effects.get("thrust_inflow_coefficient", 0.0)
    ratio = effects.get("rotor_drag_ratio_y", 1.0)
    return rotors + body[0], rotors * ratio + body[1], inflow + body[2]


def with_linear_drag(vehicle: VehicleFile, drag: tuple[float, float, float]) -> VehicleFile:
    """Return a vehicle with a linear drag of the body instead of rotor drag."""
    aerodynamics = vehicle.aerodynamics.replace(rotor_drag_coefficient=0.0)
    return with_effects(
        vehicle.replace(aerodynamics=aerodynamics),
        ("rotor_drag_ratio_y", "thrust_inflow_coefficient"),
        dict(zip(LINEAR_DRAG, drag, strict=True)),
    )


def with_one_drag(vehicle: VehicleFile) -> VehicleFile:
    """Return a vehicle with the mean linear drag along x and y in all directions."""
    x, y, _ = drag_at_hover(vehicle)
    return with_linear_drag(vehicle, (fmean((x, y)),) * 3)


def with_one_damping(vehicle: VehicleFile) -> VehicleFile:
    """Return a vehicle with the mean damping of rotation about all axes."""
    damping = fmean(max(vehicle.effects.get(name, 0.0), 0.0) for name in ANGULAR_DRAG)
    damped = dict.fromkeys(ANGULAR_DRAG, damping) if damping > 0 else {}
    return with_effects(vehicle, ANGULAR_DRAG, damped)


def with_linear_thrust(vehicle: VehicleFile, *, idle: bool) -> VehicleFile:
    """Return a vehicle whose thrust, instead of rotor speed, has the lag.

    Its "rotor speed" is the thrust, scaled to the rotor speed in the hover.

    Parameters
    ----------
    idle
        Whether the commanded thrust follows from the rotor speed (by a parabola through zero
        command, hover and full command); otherwise it is proportional to the command.

    Raises
    ------
    ExportError
        Such a parabola falls at small commands.
    """
    aerodynamics, motor = vehicle.aerodynamics, vehicle.motor
    if aerodynamics.thrust_law == "linear":
        return vehicle
    speed, thrust = hover_speed(vehicle), vehicle.mass * GRAVITY / len(vehicle.rotors)
    unit = speed / thrust

    low, full, bend = 0.0, unit * full_thrust(vehicle), 0.0
    hover = hover_command(vehicle)
    if idle and hover is not None:
        low = unit * aerodynamics.motor_constant * rotor_speed(vehicle, 0.0) ** 2
        bend = ((full - low) - (speed - low) / hover) / (1.0 - hover)
        if bend >= full - low:
            raise ExportError(
                vehicle.name,
                "has rotors that stand still at small commands: no parabola rises through its "
                "thrust at zero command, hover and full command",
                "correct input_offset or zero_position_armed, or export json",
            )
    return vehicle.replace(
        motor=motor.replace(
            input_scaling=full - low - bend,
            zero_position_armed=low,
            quadratic=bend,
            input_offset=0.0,
            max_rotor_velocity=full,
        ),
        aerodynamics=aerodynamics.replace(motor_constant=1.0 / unit, thrust_law="linear"),
    )


MAX_GZ_SPEED = 1000.0
"""rad/s. PX4's bridge to gz-sim takes no higher rotor speeds."""


def gz_speed_unit(vehicle: VehicleFile) -> float:
    """Return the rad/s in gz-sim per rad/s of the vehicle: 1, or less for fast rotors.

    A model with scaled speeds and constants moves in the same way.
    """
    return min(1.0, MAX_GZ_SPEED / rotor_speed(vehicle, 1.0))


def with_speed_unit(vehicle: VehicleFile, unit: float) -> VehicleFile:
    """Return the vehicle with all rotor speeds multiplied by ``unit``, and scaled constants."""
    motor, aerodynamics = vehicle.motor, vehicle.aerodynamics
    return vehicle.replace(
        motor=motor.replace(
            input_scaling=motor.input_scaling * unit,
            zero_position_armed=motor.zero_position_armed * unit,
            quadratic=motor.quadratic * unit,
            max_rotor_velocity=motor.max_rotor_velocity * unit,
        ),
        aerodynamics=aerodynamics.replace(
            motor_constant=aerodynamics.motor_constant / unit**2,
            rotor_drag_coefficient=aerodynamics.rotor_drag_coefficient / unit,
            rolling_moment_coefficient=aerodynamics.rolling_moment_coefficient / unit,
        ),
    )


def _with_whole_speeds(vehicle: VehicleFile) -> VehicleFile:
    """Return a vehicle whose rotor speeds are linear in the command, between whole rad/s.

    They are whole in gz-sim's unit, and never negative.

    Raises
    ------
    ExportError
        The rotors turn too slowly for whole rad/s.
    """
    unit = gz_speed_unit(vehicle)
    speeds = (max(rotor_speed(vehicle, command), 0.0) for command in (0.0, 1.0))
    low, high = (round(unit * speed) / unit for speed in speeds)
    if low == high:
        what = f"has rotors of {low:g} to {high:g} rad/s, and gz-sim is told of whole rad/s"
        raise ExportError(vehicle.name, what, "correct its motor")
    motor = vehicle.motor.replace(
        input_scaling=high - low, zero_position_armed=low, input_offset=0.0, quadratic=0.0
    )
    fastest = max(motor.max_rotor_velocity, high)
    return with_body_torque(vehicle.replace(motor=motor.replace(max_rotor_velocity=fastest)))


# simulators


def registry_entries(
    target: str, other: Mapping[str, NotCarried] = MappingProxyType({})
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
            "max_relative_airspeed": NotCarried(
                "thrust in gz-sim does not depend on the airspeed", NO_LOSS
            ),
            "rolling_moment_coefficient": NotCarried(
                "gz-sim adds rolling moments up whichever way rotors turn, so that 0 is written",
                0.0,
            ),
        },
    ),
    laws=_with_whole_speeds,
)
CENTRE = {f"center_of_mass_{axis}": "rotor positions" for axis in "xyz"}
MOTORS = ("input_scaling", "zero_position_armed", "input_offset", "quadratic")
_NOT_MODELLED = {
    "rolling_moment_coefficient": NotCarried("it has no such term", 0.0),
    "max_relative_airspeed": NotCarried("its thrust does not depend on the airspeed", NO_LOSS),
}
"""Coefficients of Gazebo's motor model that the others lack, and why."""
_BODY = ("mass", "inertia_xx", "inertia_yy", "inertia_zz")
LINEAR_DRAG = ("linear_drag_x", "linear_drag_y", "linear_drag_z")
ANGULAR_DRAG = ("angular_drag_x", "angular_drag_y", "angular_drag_z")


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
            return Written(held[row.name])
        if row.name in _NOT_MODELLED:
            return _NOT_MODELLED[row.name]
        if row.scope != "vehicle":
            return _SETUP_ENTRY
        return NotCarried(f"{title} has no such term", row.neutral)

    return entry


def about_centre_of_mass(vehicle: VehicleFile) -> VehicleFile:
    """Return a vehicle whose rotor positions count from its centre of mass."""
    offset = [vehicle.effects.get(name, 0.0) for name in CENTRE]
    rotors = tuple(
        rotor.replace(position=tuple(at - o for at, o in zip(rotor.position, offset, strict=True)))
        for rotor in vehicle.rotors
    )
    return with_body_torque(with_effects(vehicle.replace(rotors=rotors), CENTRE))


THIS_PROJECT = Simulator(
    name="",
    title="this project",
    version="",
    source="sim_jax",
    deviations=(),
    entry=lambda row: Written(".".join(row.place)),
    laws=lambda vehicle: vehicle,
)

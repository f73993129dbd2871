"""The vehicle file: the coefficients of one multirotor, under the names that Gazebo users know.

Their values are taken out of vehicle and controller files here, and put into vehicle files.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from annotated_types import Le
from pydantic import AfterValidator, Field, JsonValue, create_model, model_validator

from tuner.core.disk import write_text
from tuner.core.errors import ConfigError, did_you_mean
from tuner.core.yaml_section import (
    NonNegative,
    Number,
    Positive,
    Section,
    Vector,
    build,
    commented,
    dump_yaml,
    read_model,
    refuse,
)
from tuner.vehicle.coefficient import Coefficient
from tuner.vehicle.controller import ControllerFile
from tuner.vehicle.motor_orders import MotorOrder
from tuner.vehicle.registry import COEFFICIENTS

REFERENCE_MASS, REFERENCE_ARM = 2.079, 0.25
"""kg, and m from the centre to a rotor, of the vehicle for which the registry's numbers hold."""


@dataclass(frozen=True)
class Size:
    """Mass and arm of a vehicle over those of the registry's."""

    mass: float = 1.0
    arm: float = 1.0


def size_of(vehicle: VehicleFile) -> Size:
    """Return the size of a vehicle."""
    arm = float(np.mean([np.hypot(*rotor.position[:2]) for rotor in vehicle.rotors]))
    return Size(vehicle.mass / REFERENCE_MASS, arm / REFERENCE_ARM)


def scaled_to_size(row: Coefficient, size: Size) -> Coefficient:
    """Return a coefficient's row with bounds, prior and step scaled to a vehicle's size.

    Logarithmic ones stay: their limits are factors.
    """
    if row.scale == "log":
        return row
    ratio = size.mass**row.mass_exponent * size.arm**row.length_exponent
    bounds = row.bounds
    if isinstance(bounds, tuple):
        bounds = (bounds[0] * ratio, bounds[1] * ratio)
    return replace(row, bounds=bounds, prior_sd=row.prior_sd * ratio, step=row.step * ratio)


#: What the quad-X mixer assumes of each rotor in PX4's order: sign of x, sign of y, spin.
QUAD_X = ((+1, -1, "ccw"), (-1, +1, "ccw"), (+1, +1, "cw"), (-1, -1, "cw"))


ROTOR_COUNTS = (4, 6, 8)
UNIT_COLUMN = 44
#: Of numbers that are not fitted.
_OTHER_UNITS = {
    ("", "rotors"): "positions in m from the centre of mass: forward, left, up",
    ("motor", "max_rotor_velocity"): "rad/s",
    ("battery", "reference_voltage"): "V",
}


class InertiaSection(Section):
    """Principal moments of inertia about the centre of mass, kg m², body axes forward-left-up."""

    xx: Positive
    yy: Positive
    zz: Positive

    @model_validator(mode="after")
    def _belongs_to_a_body(self) -> Self:
        for name, value in self:
            others = self.xx + self.yy + self.zz - value
            if value > others * (1 + 1e-9):
                raise refuse(
                    f"inertia.{name} is {value!r}, more than the other two together ({others:.6g})",
                    "no rigid body has such moments, correct one of them",
                )
        return self


class RotorEntry(Section):
    """Where a rotor sits (body frame forward-left-up, m, from the centre of mass) and how it turns.

    The spin is seen from above.
    """

    position: Vector
    spin: Literal["ccw", "cw"]


class MotorSection(Section):
    """From command to rotor speed.

    With ``v = u + input_offset``, the speed that a command u in 0..1 asks for is
    ``min(v·input_scaling + v²·quadratic + zero_position_armed, max_rotor_velocity)``; the rotor
    follows with one of two first-order lags.

    Attributes
    ----------
    input_scaling
        rad/s per unit of command.
    zero_position_armed
        rad/s at zero command.
    max_rotor_velocity
        rad/s.
    time_constant_up, time_constant_down
        s, while speeding up and while slowing down.
    input_offset
        Added to the command, 0..1.
    quadratic
        rad/s per squared unit of command; negative bends the curve down.
    """

    input_scaling: Positive
    zero_position_armed: NonNegative
    max_rotor_velocity: Positive
    time_constant_up: Positive
    time_constant_down: Positive
    input_offset: Number = 0.0
    quadratic: Number = 0.0


class AerodynamicsSection(Section):
    """From rotor speed and air velocity to force and moment.

    Attributes
    ----------
    motor_constant
        N s²/rad²: thrust per squared rotor speed.
    moment_constant
        m: drag torque per thrust.
    rotor_drag_coefficient
        N s²/(rad m).
    rolling_moment_coefficient
        N s²/rad.
    max_relative_airspeed
        m/s along the rotor axis, at which thrust vanishes.
    reaction_torque
        Whether the drag torque acts about the body's z axis or, as one simulator has it, the
        world's.
    thrust_law
        ``linear`` for a simulator whose thrust goes with the rotor speed itself (motor_constant in
        N s/rad); left out, it goes with the square.
    """

    motor_constant: Positive
    moment_constant: NonNegative
    rotor_drag_coefficient: NonNegative
    rolling_moment_coefficient: NonNegative
    max_relative_airspeed: Positive = 25.0
    reaction_torque: Literal["body", "world"] = "body"
    thrust_law: Literal["linear"] | None = None


def max_latency(latency: str) -> float:
    """Return the s that the simulation's delay line reaches back, as far as a latency's bound."""
    bounds = COEFFICIENTS[latency].bounds
    assert isinstance(bounds, tuple)
    return bounds[1]


class SetupSection(Section):
    """What the set-up adds to the vehicle.

    Attributes
    ----------
    estimate_latency
        s by which the state that the controllers see is old.
    actuator_latency
        s from a motor command to its effect.
    gyro_cutoff
        Hz of the gyro's low-pass filter; None where the controller file's holds.
    """

    estimate_latency: Annotated[NonNegative, Le(max_latency("estimate_latency"))] = 0.0
    actuator_latency: Annotated[NonNegative, Le(max_latency("actuator_latency"))] = 0.0
    gyro_cutoff: Positive | None = None


class BatterySection(Section):
    """What the motors are fed by.

    Attributes
    ----------
    reference_voltage
        V at which a command asks for the speed of the motor section; with ``battery_exponent``, it
        asks for less as the recorded voltage falls below. None takes that of the fullest battery
        without load.
    """

    reference_voltage: Positive | None = None


def _known_effects(effects: dict[str, float]) -> dict[str, float]:
    known = [name for name, coefficient in COEFFICIENTS.items() if coefficient.is_effect]
    for name in effects:
        if name not in known:
            raise refuse(f"unknown key 'effects.{name}'", did_you_mean(name, known))
    return effects


class VehicleFile(Section):
    """One multirotor.

    Attributes
    ----------
    name
        What reports call it.
    mass
        kg, take-off mass.
    inertia
        Principal moments of inertia.
    rotors
        Four in PX4's motor order (front right, rear left, front left, rear right), or six or eight
        in any order.
    motor_order
        In which its recordings list the motors: ``px4``, ``ardupilot``, ``betaflight``,
        ``crazyflie`` or the recorded motor, from 1, of each rotor; a topic map that says so wins.
    motor, aerodynamics, setup, battery
        See there.
    effects
        Coefficients of terms beyond Gazebo's motor model, name -> value in the unit of the
        registry (`tuner.vehicle`). A term whose coefficients are left out does not act.
    source
        Where the numbers come from: free text and numbers, kept as they are.
    """

    name: str
    mass: Positive
    inertia: InertiaSection
    rotors: tuple[RotorEntry, ...]
    motor_order: MotorOrder | None = None
    motor: MotorSection
    aerodynamics: AerodynamicsSection
    setup: SetupSection = SetupSection()
    battery: BatterySection = BatterySection()
    effects: Annotated[dict[str, Number], AfterValidator(_known_effects)] = Field(
        default_factory=dict
    )
    source: dict[str, JsonValue] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _has_rotors_in_order(self) -> Self:
        if len(self.rotors) not in ROTOR_COUNTS:
            counts = ", ".join(map(str, ROTOR_COUNTS[:-1]))
            raise refuse(
                f"rotors are {len(self.rotors)}", f"list {counts} or {ROTOR_COUNTS[-1]} rotors"
            )
        if not self.is_quad:
            return self
        for index, (rotor, expected) in enumerate(zip(self.rotors, QUAD_X, strict=True)):
            sign_x, sign_y, spin = expected
            if rotor.position[0] * sign_x <= 0 or rotor.position[1] * sign_y <= 0:
                raise refuse(
                    f"rotors[{index}] sits at {list(rotor.position)}",
                    "list the rotors in PX4's order: front right, rear left, front left, rear "
                    "right (x forward, y left)",
                )
            if rotor.spin != spin:
                raise refuse(
                    f"rotors[{index}] turns {rotor.spin}",
                    "the quad-X mixer needs the first two rotors ccw and the last two cw",
                )
        return self

    @property
    def is_quad(self) -> bool:
        """Whether it has four rotors, as the simulated mixer needs."""
        return len(self.rotors) == len(QUAD_X)


def check_rotors(vehicle: VehicleFile) -> None:
    """Refuse a vehicle that can be written and judged, but neither simulated nor fitted.

    Raises
    ------
    ConfigError
        It has more than four rotors: the mixer is the quad X's, and recordings hold four motors.
    """
    if not vehicle.is_quad:
        raise ConfigError(
            vehicle.name,
            f"has {len(vehicle.rotors)} rotors, and only four are simulated and read",
            "name a vehicle of four; one of six or eight can be exported and audited",
        )


def check_filter(vehicle: VehicleFile, controller: ControllerFile) -> None:
    """Refuse a filter of the gyro that the simulated rate loop cannot have.

    Raises
    ------
    ConfigError
        The vehicle file's cutoff is not below half of the loop's rate.
    """
    cutoff, half = vehicle.setup.gyro_cutoff, controller.rate.rate / 2
    if cutoff is not None and cutoff >= half:
        raise ConfigError(
            vehicle.name,
            f"setup.gyro_cutoff is {cutoff:g} Hz, not below half of rate.rate of the controller "
            f"file ({half:g} Hz)",
            "lower it, or leave it out for the controller file's",
        )


def read_vehicle(path: str | Path) -> VehicleFile:
    """Read a vehicle file.

    Raises
    ------
    ConfigError
        In one line: the file, the key, its value, what it should be.
    """
    return read_model(VehicleFile, path)


def write_vehicle(vehicle: VehicleFile, path: str | Path, *, header: str = "") -> None:
    """Write a vehicle file that `read_vehicle` reads back to an equal vehicle.

    Parameters
    ----------
    path
        The file to make or replace; it appears whole.
    header
        Comment lines for the top of the file.

    Raises
    ------
    OutputError
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


def _with_units(text: str) -> str:
    """Put a number's unit behind its line."""
    units = {coefficient.place: coefficient.unit for coefficient in COEFFICIENTS.values()}
    units |= _OTHER_UNITS
    section = ""
    lines = []
    for line in text.removesuffix("\n").split("\n"):
        key = line.partition(":")[0]
        inside = line.startswith("  ")
        if not inside:
            section = key
        unit = units.get((section if inside else "", key.strip()))
        lines.append(f"{line + '  ':<{UNIT_COLUMN}}# {unit}" if unit else line)
    return "\n".join(lines) + "\n"


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


def check_value(name: str, value: float, where: str) -> None:
    """Refuse a value that no vehicle file can give a coefficient.

    Raises
    ------
    ConfigError
        It is negative, say, or no number; ``where`` says of what.
    """
    section, key = COEFFICIENTS[name].place
    if not COEFFICIENTS[name].is_effect:  # those are any numbers
        holder = VehicleFile.model_fields[section].annotation if section else VehicleFile
        field = holder.model_fields[key]  # type: ignore[union-attr]
        alone: dict[str, Any] = {key: (field.annotation, field)}
        build(create_model(key, __base__=Section, **alone), {key: value}, where)


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

"""What a vehicle's numbers come to: rotor speed, thrust and hover; and laws of simulators.

A law gives the vehicle with which this project's own simulation flies like a simulator that
computes something otherwise.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from statistics import fmean
from types import MappingProxyType

from sim_jax.constants import GRAVITY
from tuner.core.errors import ExportError
from tuner.vehicle import VehicleFile

LINEAR_DRAG = ("linear_drag_x", "linear_drag_y", "linear_drag_z")
ANGULAR_DRAG = ("angular_drag_x", "angular_drag_y", "angular_drag_z")
CENTRE = {f"center_of_mass_{axis}": "rotor positions" for axis in "xyz"}
MAX_GZ_SPEED = 1000.0
"""rad/s. PX4's bridge to gz-sim takes no higher rotor speeds."""


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


def with_body_torque(vehicle: VehicleFile) -> VehicleFile:
    """Return a vehicle whose rotors' reaction torque acts about the body's z axis."""
    return vehicle.replace(aerodynamics=vehicle.aerodynamics.replace(reaction_torque="body"))


def with_effects(
    vehicle: VehicleFile,
    without: Collection[str],
    effects: Mapping[str, float] = MappingProxyType({}),
) -> VehicleFile:
    """Return a vehicle without some effects, and with others."""
    left = {name: value for name, value in vehicle.effects.items() if name not in without}
    return vehicle.replace(effects={**left, **effects})


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


def with_linear_drag(vehicle: VehicleFile) -> VehicleFile:
    """Return a vehicle with a linear drag of the body instead of rotor drag, as in the hover."""
    aerodynamics = vehicle.aerodynamics.replace(rotor_drag_coefficient=0.0)
    return with_effects(
        vehicle.replace(aerodynamics=aerodynamics),
        ("rotor_drag_ratio_y", "thrust_inflow_coefficient"),
        dict(zip(LINEAR_DRAG, drag_at_hover(vehicle), strict=True)),
    )


def with_one_drag(vehicle: VehicleFile) -> VehicleFile:
    """Return a vehicle with the mean linear drag along x and y in all directions."""
    x, y, _ = drag_at_hover(vehicle)
    return with_effects(with_linear_drag(vehicle), (), dict.fromkeys(LINEAR_DRAG, fmean((x, y))))


def with_one_damping(vehicle: VehicleFile, *, of_rate: bool = False) -> VehicleFile:
    """Return a vehicle with the mean damping of rotation about all axes.

    With ``of_rate`` body rates decay equally about all axes, in 1/s; otherwise the moments are
    equal, in N m s/rad.
    """
    weights = [moment if of_rate else 1.0 for _, moment in vehicle.inertia]
    moments = (max(vehicle.effects.get(name, 0.0), 0.0) for name in ANGULAR_DRAG)
    damping = fmean(moment / weight for moment, weight in zip(moments, weights, strict=True))
    each = (damping * weight for weight in weights)
    damped = dict(zip(ANGULAR_DRAG, each, strict=True)) if damping > 0 else {}
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


def gz_speed_unit(vehicle: VehicleFile) -> float:
    """Return the rad/s in gz-sim per rad/s of the vehicle: 1, or less for fast rotors.

    A model with scaled speeds and constants moves in the same way.
    """
    return min(1.0, MAX_GZ_SPEED / rotor_speed(vehicle, 1.0))


def scaling_in_words(fastest: float) -> str:
    """Return a clause on the scale of rotors in gz-sim that turn at up to some rad/s."""
    return (
        f"rotors turn at up to {fastest:.0f} rad/s and PX4 lets gz-sim be told of "
        f"{MAX_GZ_SPEED:.0f} at most: speeds are scaled by {MAX_GZ_SPEED / fastest:.6g}"
    )


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


def with_whole_speeds(vehicle: VehicleFile) -> VehicleFile:
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


def about_centre_of_mass(vehicle: VehicleFile) -> VehicleFile:
    """Return a vehicle whose rotor positions count from its centre of mass."""
    offset = [vehicle.effects.get(name, 0.0) for name in CENTRE]
    rotors = tuple(
        rotor.replace(position=tuple(at - o for at, o in zip(rotor.position, offset, strict=True)))
        for rotor in vehicle.rotors
    )
    return with_body_torque(with_effects(vehicle.replace(rotors=rotors), CENTRE))

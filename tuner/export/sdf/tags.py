"""The tags that are ours, and the place of each in a vehicle file."""

from __future__ import annotations

from tuner.config import VehicleFile

#: Of a motor model plugin, in Gazebo classic and gz-sim alike.
MOTOR_TAGS = {
    "timeConstantUp": ("motor", "time_constant_up"),
    "timeConstantDown": ("motor", "time_constant_down"),
    "maxRotVelocity": ("motor", "max_rotor_velocity"),
    "motorConstant": ("aerodynamics", "motor_constant"),
    "momentConstant": ("aerodynamics", "moment_constant"),
    "rotorDragCoefficient": ("aerodynamics", "rotor_drag_coefficient"),
    "rollingMomentCoefficient": ("aerodynamics", "rolling_moment_coefficient"),
}

#: Of a control channel of PX4's interface plugin for Gazebo classic.
CHANNEL_TAGS = {
    "input_offset": ("motor", "input_offset"),
    "input_scaling": ("motor", "input_scaling"),
    "zero_position_armed": ("motor", "zero_position_armed"),
}

#: m/s at which both simulators' motor model plugins let thrust vanish.
PLUGIN_AIRSPEED = 25.0


def values(vehicle: VehicleFile, tags: dict[str, tuple[str, str]]) -> dict[str, float]:
    """Return tag to value for a vehicle."""
    return {
        tag: float(getattr(getattr(vehicle, section), key)) for tag, (section, key) in tags.items()
    }


def as_text(value: float) -> str:
    """Return a number as it is written into a model: twelve digits at most, no needless ones."""
    return format(value, ".12g")


def as_flown(vehicle: VehicleFile) -> VehicleFile:
    """Return the vehicle as the plugins fly it, without what they have no place for."""
    return vehicle.replace(
        motor=vehicle.motor.replace(quadratic=0.0),
        aerodynamics=vehicle.aerodynamics.replace(
            max_relative_airspeed=PLUGIN_AIRSPEED, reaction_torque="body"
        ),
    )


def lost_in(vehicle: VehicleFile) -> tuple[str, ...]:
    """Return what of a vehicle the format has no place for, in words."""
    setup, flown = vehicle.setup, as_flown(vehicle)
    airspeed = vehicle.aerodynamics.max_relative_airspeed
    said = []
    if flown.motor.quadratic != vehicle.motor.quadratic:
        said.append(f"there is no tag for quadratic ({vehicle.motor.quadratic:g} rad/s)")
    if airspeed != PLUGIN_AIRSPEED:
        said.append(
            f"the plugins have {PLUGIN_AIRSPEED:g} m/s built in, not max_relative_airspeed "
            f"{airspeed:g} m/s"
        )
    if flown.aerodynamics.reaction_torque != vehicle.aerodynamics.reaction_torque:
        said.append("the plugins' reaction torque acts about the body's z axis, not the world's")
    if setup.estimate_latency or setup.actuator_latency:
        said.append(
            f"there is no tag for estimate_latency ({setup.estimate_latency:g} s) and "
            f"actuator_latency ({setup.actuator_latency:g} s), which belong to the set-up"
        )
    return tuple(said)

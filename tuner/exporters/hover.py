"""What a vehicle's rotors give: speeds by the command, thrust at full command, and the hover."""

from __future__ import annotations

import math

from sim_jax.constants import GRAVITY
from tuner.vehicle import VehicleFile


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
    """Return the rotor speed in rad/s at which the rotors carry the vehicle."""
    aerodynamics = vehicle.aerodynamics
    squared = vehicle.mass * GRAVITY / len(vehicle.rotors) / aerodynamics.motor_constant
    return squared if aerodynamics.thrust_law == "linear" else math.sqrt(squared)


def hover_command(vehicle: VehicleFile) -> float | None:
    """Return the command 0..1 at which the vehicle hovers; None if full command does not do."""
    wanted = hover_speed(vehicle)
    low, high = 0.0, 1.0
    if not rotor_speed(vehicle, low) < wanted < rotor_speed(vehicle, high):
        return None
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if rotor_speed(vehicle, middle) < wanted else (low, middle)
    return 0.5 * (low + high)

"""Commanded thrust and torque as the motor commands that, by the vehicle file, give them.

Some controllers log the wrench that they ask for instead of what their motors received. The vehicle
file's arms, drag and curve share it out between the rotors; what these are wrong by, a fit finds.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tuner.objective.explained import levers
from tuner.recordings.flight import Array, Flight, Series
from tuner.recordings.interpolation import resample
from tuner.recordings.notes import Note, NoteCode
from tuner.vehicle import VehicleFile

WRENCH = ("commanded_thrust", "commanded_torque")


def with_commands(flight: Flight, vehicle: VehicleFile) -> Flight:
    """Return a flight with motor commands, if it holds a commanded wrench and no commands.

    Parameters
    ----------
    flight
        The recording.
    vehicle
        Of four rotors; else the flight is returned as it is.
    """
    has_wrench = all(flight.has(name) for name in WRENCH)
    if flight.has("command") or not has_wrench or len(vehicle.rotors) != 4:
        return flight
    thrust, torque = (flight.series[name] for name in WRENCH)
    moments = np.column_stack(
        [np.interp(thrust.time, torque.time, column) for column in torque.values.T]
    )
    command = commands_of(np.column_stack([thrust.values, moments]), vehicle)
    series = Series(thrust.time, command)
    on_clock = resample("command", series, flight.time)
    nearest = command[int(np.argmin(np.abs(thrust.time)))]
    return replace(
        flight,
        series={**flight.series, "command": series},
        signals={**flight.signals, "command": on_clock},
        initial=replace(flight.initial, command=nearest),
        notes=(*flight.notes, Note(NoteCode.COMMAND_DERIVED)),
    )


def commands_of(wrench: Array, vehicle: VehicleFile) -> Array:
    """Return commands (n, 4) of thrust in N and torque in N m (n, 4), body FLU.

    They are above 1 where the vehicle file's rotors are too weak for what was commanded. The signs
    of a quad-X's rotors, which a vehicle file must have, make the matrix regular.
    """
    shares = np.vstack([np.ones(4), levers(vehicle).T])
    lift = np.maximum(wrench @ np.linalg.inv(shares).T, 0.0)
    motor = vehicle.motor
    speed = np.sqrt(lift / vehicle.aerodynamics.motor_constant) - motor.zero_position_armed
    linear, square = motor.input_scaling, motor.quadratic
    root = np.sqrt(np.maximum(linear * linear + 4.0 * square * speed, 0.0))
    shifted = 2.0 * speed / (linear + root)  # of square·u² + linear·u = speed, stable at 0
    return np.asarray(np.maximum(shifted - motor.input_offset, 0.0))

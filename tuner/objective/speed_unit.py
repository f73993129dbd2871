"""The unit of recorded rotor speeds, told by the weight that the rotors carry.

In the mean over a flight, n k Ω² is the weight m g, and commands ask for the speeds of the vehicle
file's curve. Of rad/s, revolutions a minute and a second, which lie 9.5 and 6.3 apart, at most one
meets both.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from sim_jax.constants import GRAVITY
from tuner.core.errors import RecordingError
from tuner.objective.explained import squared_speed
from tuner.recordings.flight import Flight, Series
from tuner.recordings.notes import Note, NoteCode
from tuner.recordings.unit_detection import UNITS
from tuner.vehicle import VehicleFile

SPEED_UNITS = {"si": "in rad/s", "rpm": "in revolutions a minute", "hz": "in revolutions a second"}
"""Units that rotor speeds come in, and how a sentence calls them."""
NEAR = math.sqrt(6.0)
"""Times that a speed may be off what the vehicle file says: units lie over its square apart."""


def with_speeds_in_si(flight: Flight, vehicle: VehicleFile) -> Flight:
    """Return a flight with its rotor speeds in rad/s, where nothing says in which unit they are.

    Raises
    ------
    RecordingError
        In no unit do they carry the vehicle.
    """
    note = next((n for n in flight.notes if n.code is NoteCode.SPEED_UNIT_OPEN), None)
    if note is None or not flight.has("rotor_speed"):
        return flight
    (assumed,) = note.names
    ratios = _ratios(flight, vehicle)
    factors = {unit: UNITS[unit][0] / UNITS[assumed][0] for unit in SPEED_UNITS}

    def fits(unit: str) -> bool:
        fastest = NEAR * vehicle.motor.max_rotor_velocity
        slow_enough = float(np.nanmedian(flight.signals["rotor_speed"])) * factors[unit] < fastest
        return slow_enough and all(1 / NEAR < ratio * factors[unit] < NEAR for ratio in ratios)

    if not ratios or fits(assumed):
        return flight
    fitting = [unit for unit in SPEED_UNITS if fits(unit)]
    if len(fitting) != 1:
        carried = ", ".join(
            f"{(ratios[0] * factor) ** 2:.2g} times the weight {SPEED_UNITS[unit]}"
            for unit, factor in factors.items()
        )
        raise RecordingError(
            flight.path,
            f"nothing says in which unit its rotor speeds are, and by the vehicle file they carry "
            f"{carried}",
            "give rotor_speed its unit (si, rpm or hz) in the topic map, and check mass and "
            "motor_constant of the vehicle",
        )
    (unit,) = fitting
    return _scaled(flight, factors[unit], SPEED_UNITS[unit])


def _ratios(flight: Flight, vehicle: VehicleFile) -> list[float]:
    """Return how many times too fast the rotors turn, by the weight and by the commands."""
    speeds = flight.signals["rotor_speed"]
    squares = float(np.nanmedian(np.square(speeds)))
    hover = vehicle.mass * GRAVITY / (len(vehicle.rotors) * vehicle.aerodynamics.motor_constant)
    ratios = [math.sqrt(squares / hover)]
    if flight.has("command"):
        asked = float(np.nanmedian(squared_speed(vehicle, "command", flight.signals["command"])))
        ratios.append(math.sqrt(squares / asked) if asked > 0 else ratios[0])
    return ratios if squares > 0 else []


def _scaled(flight: Flight, factor: float, name: str) -> Flight:
    series = flight.series["rotor_speed"]
    speeds = {"rotor_speed": Series(series.time, factor * series.values)}
    signals = {"rotor_speed": factor * flight.signals["rotor_speed"]}
    read = Note(NoteCode.UNIT_READ, count=len(series.time), names=("rotor_speed", name))
    return replace(
        flight,
        signals={**flight.signals, **signals},
        series={**flight.series, **speeds},
        initial=replace(flight.initial, rotor_speed=factor * flight.initial.rotor_speed),
        notes=(*flight.notes, read),
    )

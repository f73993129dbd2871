"""How well what was recorded of the rotors explains how the vehicle turned.

A multirotor's angular acceleration is its rotors' torque over its inertia. Where recorded commands,
or rotor speeds, do not correlate with it, nothing that is fed by them can follow the attitude:
they were logged too seldom for the loop that made them, or belong to other rotors.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from tuner.objective.recorded_inputs import linear_interpolation
from tuner.recordings.flight import Array, Flight, Series
from tuner.vehicle import VehicleFile

Source = Literal["command", "rotor_speed"]

FASTEST = 250.0
"""Hz at which signals are compared, at most."""
LATEST = 0.06
"""s by which a turn may follow a command: lag, latency and clocks."""
SMOOTHED = 3
"""Samples over which both are averaged against noise."""
FEWEST = 100
"""Samples below which nothing is said."""


@dataclass(frozen=True)
class Explained:
    """What the rotors explain of a flight's angular acceleration.

    Attributes
    ----------
    source
        What was recorded of the rotors.
    correlation
        About body x, y and z, at the delay at which roll and pitch together are met best.
    rate, gyro_rate
        Hz at which the rotors and the gyro were logged.
    """

    source: Source
    correlation: tuple[float, float, float]
    rate: float
    gyro_rate: float

    @property
    def tilting(self) -> float:
        """The mean correlation about roll and pitch."""
        return 0.5 * (self.correlation[0] + self.correlation[1])


def explained(flight: Flight, vehicle: VehicleFile, source: Source) -> Explained | None:
    """Return what a recorded signal of the rotors explains; None if too little was recorded."""
    if not flight.has(source) or "body_rate" not in flight.series:
        return None
    clock = common_clock(flight.series, source, (0.0, flight.duration))
    if clock is None:
        return None
    turning, torque = turning_and_torque(flight.series, vehicle, source, clock)
    most = max(1, round(LATEST / float(clock[1] - clock[0])))
    delays = (_correlation(turning, torque, delay) for delay in range(-1, most + 1))
    best = max(delays, key=lambda correlation: correlation[0] + correlation[1])
    rates = flight.series[source].rate, flight.series["body_rate"].rate
    return Explained(source, (best[0], best[1], best[2]), *rates)


def common_clock(
    series: Mapping[str, Series], source: Source, span: tuple[float, float]
) -> Array | None:
    """Return a uniform clock at the gyro's rate over what both signals cover of a span in s."""
    gyro, rotors = series["body_rate"], series[source]
    rate = min(FASTEST, gyro.rate)
    begin = max(span[0], gyro.time[0], rotors.time[0])
    end = min(span[1], gyro.time[-1], rotors.time[-1])
    count = int((end - begin) * rate)
    return begin + np.arange(count) / rate if count >= FEWEST else None


def turning_and_torque(
    series: Mapping[str, Series], vehicle: VehicleFile, source: Source, clock: Array
) -> tuple[Array, Array]:
    """Return angular acceleration (n, 3) in rad/s² and torque (n, 3) over motor_constant."""
    gyro, rotors = series["body_rate"], series[source]
    rates = smoothed(linear_interpolation(gyro, clock))
    turning = np.gradient(rates, clock, axis=0)
    squares = squared_speed(vehicle, source, linear_interpolation(rotors, clock))
    return turning, smoothed(squares) @ levers(vehicle)


def squared_speed(vehicle: VehicleFile, source: Source, values: Array) -> Array:
    """Return squared rotor speeds, (rad/s)², of commands by the vehicle's curve, or of speeds."""
    if source == "rotor_speed":
        return np.square(values)
    motor = vehicle.motor
    command = values + motor.input_offset
    speed = motor.zero_position_armed + (motor.input_scaling + motor.quadratic * command) * command
    return np.square(speed)


def levers(vehicle: VehicleFile) -> Array:
    """Return (rotors, 3) moments about x, y and z in m of one newton of thrust at each rotor."""
    drag = vehicle.aerodynamics.moment_constant
    rows = []
    for rotor in vehicle.rotors:
        x, y, _ = rotor.position
        rows.append((y, -x, -drag if rotor.spin == "ccw" else drag))
    return np.array(rows)


def smoothed(values: Array) -> Array:
    """Return (n, k) values averaged over `SMOOTHED` samples."""
    kernel = np.ones(SMOOTHED) / SMOOTHED
    return np.stack([np.convolve(column, kernel, "same") for column in values.T], axis=1)


def _correlation(turning: Array, torque: Array, delay: int) -> tuple[float, ...]:
    late, early = turning[max(0, delay) :], torque[: len(torque) - max(0, delay)]
    if delay < 0:
        late, early = turning[:delay], torque[-delay:]
    a, b = late - late.mean(axis=0), early - early.mean(axis=0)
    size = np.sqrt((a * a).sum(axis=0) * (b * b).sum(axis=0))
    return tuple(((a * b).sum(axis=0) / np.where(size > 0, size, np.inf)).tolist())

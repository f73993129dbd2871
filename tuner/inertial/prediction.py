"""How well a vehicle's body rate is predicted from its commands alone, half a second ahead.

From the measured body rate on, open loop::

    I dω/dt = Σ lever·k·Ω² + trim - ω × Iω

with Ω the rotor speeds that follow the commands. Air is left out: without a pose it is not known
how fast the vehicle flies.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tuner.inertial.signals import Stretch, smoothed
from tuner.objective.rotor_response import Lags, rotor_speeds
from tuner.objective.rotor_signals import levers
from tuner.recordings.flight import Array
from tuner.vehicle import ControllerFile, VehicleFile, values_of
from tuner.vehicle.model import model_of

AHEAD = 0.5
"""s."""
STRIDE = 0.1
"""s from one prediction to the next."""


@dataclass(frozen=True)
class RateErrors:
    """Mean errors, rad/s, of body rates predicted `AHEAD` s ahead.

    Attributes
    ----------
    initial, fitted
        By the vehicle that the fit began with, and by the one that it ended with.
    hold
        By the body rate that was measured at the beginning.
    """

    initial: float
    fitted: float
    hold: float


def rate_errors(
    stretches: Sequence[Stretch], initial: VehicleFile, fitted: VehicleFile
) -> RateErrors | None:
    """Return how well a flight's body rates are predicted; None where none flies long enough."""
    beginnings = [_beginnings(stretch) for stretch in stretches]
    if not sum(len(begin) for begin in beginnings):
        return None
    pairs = list(zip(stretches, beginnings, strict=True))
    missed = [
        np.concatenate([_missed(stretch, begin, vehicle) for stretch, begin in pairs])
        for vehicle in (initial, fitted, None)
    ]
    return RateErrors(*(float(np.linalg.norm(each, axis=1).mean()) for each in missed))


def _beginnings(stretch: Stretch) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    inside = np.flatnonzero(stretch.inside)
    steps, stride = round(AHEAD / stretch.step), round(STRIDE / stretch.step)
    return np.asarray(inside[: max(0, len(inside) - steps) : stride])


def _missed(
    stretch: Stretch,
    begin: np.ndarray[tuple[int], np.dtype[np.intp]],
    vehicle: VehicleFile | None,
) -> Array:
    """Return the errors (n, 3) rad/s of predictions that begin at some samples."""
    measured, steps = smoothed(stretch.body_rate, stretch.step), round(AHEAD / stretch.step)
    rate = measured[begin]
    if vehicle is not None:
        value = values_of(vehicle)
        inertia = np.array([value[f"inertia_{axis}{axis}"] for axis in "xyz"])
        trim = np.array([value.get(f"torque_trim_{axis}", 0.0) for axis in "xyz"])
        torque = value["motor_constant"] * _squares(stretch, vehicle) @ levers(vehicle) + trim
        for step in range(steps):
            moment = torque[begin + step] - np.cross(rate, inertia * rate)
            rate = rate + stretch.step * moment / inertia
    return np.asarray(rate - measured[begin + steps])


def _squares(stretch: Stretch, vehicle: VehicleFile) -> Array:
    motor, value = model_of(vehicle, ControllerFile()).vehicle.motor, values_of(vehicle)
    lags = Lags(value["time_constant_up"], value["time_constant_down"], value["actuator_latency"])
    return np.square(rotor_speeds(stretch.command, stretch.step, motor, lags))

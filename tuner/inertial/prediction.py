"""Errors of open-loop predictions of the body rate from commands, by time ahead.

From the measured body rate::

    I dω/dt = Σ lever·k·Ω² + trim - ω × Iω

with Ω the rotor speeds that follow the commands. Airspeed is unknown without a pose, and left out.
Errors of the torque accumulate, so that a constant body rate becomes the better prediction after
some time; later errors do not measure a vehicle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import starmap

import numpy as np

from tuner.core.numerics import Array
from tuner.inertial.signals import Stretch, low_pass
from tuner.objective.rotor_response import MotorLags, rotor_speeds
from tuner.objective.rotor_signals import levers
from tuner.vehicle import ControllerFile, VehicleFile, values_of
from tuner.vehicle.model import model_of

HORIZONS_S = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5)
"""Times ahead of the errors."""
STRIDE_S = 0.1
"""Time from one prediction to the next."""


@dataclass(frozen=True)
class RateErrors:
    """Mean errors, rad/s, of body rates predicted so far ahead.

    Attributes
    ----------
    seconds
        One of `HORIZONS_S`.
    initial, fitted
        By the initial and by the fitted vehicle.
    hold
        By a constant body rate.
    """

    seconds: float
    initial: float
    fitted: float
    hold: float


def rate_errors(
    stretches: Sequence[Stretch], initial: VehicleFile, fitted: VehicleFile
) -> tuple[RateErrors, ...]:
    """Return the errors of a flight's predictions; none without a stretch."""
    if not stretches:
        return ()
    missed = [
        np.concatenate([_prediction_errors(stretch, vehicle) for stretch in stretches], axis=1)
        for vehicle in (initial, fitted, None)
    ]
    errors = np.linalg.norm(missed, axis=-1).mean(axis=-1)
    return tuple(starmap(RateErrors, zip(HORIZONS_S, *errors.tolist(), strict=True)))


def _prediction_errors(stretch: Stretch, vehicle: VehicleFile | None) -> Array:
    """Return the errors (S, n, 3) rad/s of predictions that begin every `STRIDE_S`."""
    measured, inside = low_pass(stretch.body_rate, stretch.step), np.flatnonzero(stretch.inside)
    places = [round(seconds / stretch.step) for seconds in HORIZONS_S]
    begin = inside[: max(0, len(inside) - places[-1]) : round(STRIDE_S / stretch.step)]
    rates = [measured[begin]]
    if vehicle is not None:
        value = values_of(vehicle)
        inertia = np.array([value[f"inertia_{axis}{axis}"] for axis in "xyz"])
        trim = np.array([value.get(f"torque_trim_{axis}", 0.0) for axis in "xyz"])
        motor = model_of(vehicle, ControllerFile()).vehicle.motor
        lags = MotorLags(
            value["time_constant_up"], value["time_constant_down"], value["actuator_latency"]
        )
        speeds = rotor_speeds(stretch.command, stretch.step, motor, lags)
        torque = value["motor_constant"] * np.square(speeds) @ levers(vehicle) + trim
        for step in range(places[-1]):
            moment = torque[begin + step] - np.cross(rates[-1], inertia * rates[-1])
            rates.append(rates[-1] + stretch.step * moment / inertia)
    return np.stack([rates[min(n, len(rates) - 1)] - measured[begin + n] for n in places])

"""How well a vehicle's body rate is predicted from its commands alone, and how far ahead.

From the measured body rate on, open loop::

    I dω/dt = Σ lever·k·Ω² + trim - ω × Iω

with Ω the rotor speeds that follow the commands. Air is left out: without a pose it is not known
how fast the vehicle flies. What commands do not say of the torque adds up, so that holding the body
rate is right more nearly from some time on: beyond it errors say nothing of a vehicle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import starmap

import numpy as np

from tuner.core.numerics import Array
from tuner.inertial.signals import Stretch, smoothed
from tuner.objective.rotor_response import Lags, rotor_speeds
from tuner.objective.rotor_signals import levers
from tuner.vehicle import ControllerFile, VehicleFile, values_of
from tuner.vehicle.model import model_of

AHEAD = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5)
"""s."""
STRIDE = 0.1
"""s from one prediction to the next."""


@dataclass(frozen=True)
class RateErrors:
    """Mean errors, rad/s, of body rates predicted so far ahead.

    Attributes
    ----------
    seconds
        One of `AHEAD`.
    initial, fitted
        By the vehicle that the fit began with, and by the one that it ended with.
    hold
        By the body rate that was measured at the beginning.
    """

    seconds: float
    initial: float
    fitted: float
    hold: float


def rate_errors(
    stretches: Sequence[Stretch], initial: VehicleFile, fitted: VehicleFile
) -> tuple[RateErrors, ...]:
    """Return how well a flight's body rates are predicted; none where none flies long enough."""
    if not stretches:
        return ()
    missed = [
        np.concatenate([_missed(stretch, vehicle) for stretch in stretches], axis=1)
        for vehicle in (initial, fitted, None)
    ]
    errors = np.linalg.norm(missed, axis=-1).mean(axis=-1)
    return tuple(starmap(RateErrors, zip(AHEAD, *errors.tolist(), strict=True)))


def _missed(stretch: Stretch, vehicle: VehicleFile | None) -> Array:
    """Return the errors (S, n, 3) rad/s of predictions that begin every `STRIDE`."""
    measured, inside = smoothed(stretch.body_rate, stretch.step), np.flatnonzero(stretch.inside)
    places = [round(seconds / stretch.step) for seconds in AHEAD]
    begin = inside[: max(0, len(inside) - places[-1]) : round(STRIDE / stretch.step)]
    rates = [measured[begin]]
    if vehicle is not None:
        value = values_of(vehicle)
        inertia = np.array([value[f"inertia_{axis}{axis}"] for axis in "xyz"])
        trim = np.array([value.get(f"torque_trim_{axis}", 0.0) for axis in "xyz"])
        torque = value["motor_constant"] * _squares(stretch, vehicle) @ levers(vehicle) + trim
        for step in range(places[-1]):
            moment = torque[begin + step] - np.cross(rates[-1], inertia * rates[-1])
            rates.append(rates[-1] + stretch.step * moment / inertia)
    return np.stack([rates[min(n, len(rates) - 1)] - measured[begin + n] for n in places])


def _squares(stretch: Stretch, vehicle: VehicleFile) -> Array:
    motor, value = model_of(vehicle, ControllerFile()).vehicle.motor, values_of(vehicle)
    lags = Lags(value["time_constant_up"], value["time_constant_down"], value["actuator_latency"])
    return np.square(rotor_speeds(stretch.command, stretch.step, motor, lags))

"""Whether recorded rotor speeds, with what air does to rotors, predict how one vehicle turns."""

from __future__ import annotations

import numpy as np

from tuner.equation_error.measured import Measured, measured
from tuner.equation_error.regression import convolved
from tuner.objective.explained import levers
from tuner.recordings.flight import Array, Flight
from tuner.vehicle import VehicleFile

AHEAD = 0.1
"""s after which a predicted body rate is compared with the one that it began with."""


def predicts_turning(flight: Flight, vehicle: VehicleFile) -> bool:
    """Return whether a regression on one half of a flight predicts the other better than holding.

    Roll and pitch rate, `AHEAD` s later; the regression knows nothing but where rotors sit.
    """
    steps = measured(flight)
    if steps is None:
        return False
    kernel = np.ones(round(AHEAD / steps.step)) * steps.step
    half, squares = len(steps.rotor_speed) // 2, np.zeros(2)
    for axis in (0, 1):
        columns, turning = regressors(steps, vehicle)[axis], steps.accelerations[:, 3 + axis]
        for fitted in (np.arange(len(turning)) < half, np.arange(len(turning)) >= half):
            inside = fitted & steps.known
            weights = np.linalg.lstsq(columns[inside], turning[inside], rcond=None)[0]
            left = np.stack([turning - columns @ weights, turning], axis=1)[~fitted]
            squares += np.sum(convolved(left, steps.known[~fitted], kernel) ** 2, axis=0)
    return bool(squares[0] < squares[1])


def regressors(steps: Measured, vehicle: VehicleFile) -> tuple[Array, Array, Array]:
    """Return about x, y and z what angular acceleration is regressed on, (N, k).

    The rotors' torque up to a factor, air velocity across and body rate times the sum of the
    rotors' speeds, and a steady part.
    """
    speed, motion = steps.rotor_speed, steps.motion
    body = np.asarray(motion.attitude.to_body(motion.velocity).stacked()).T
    rate = np.asarray(motion.body_rate.stacked()).T
    torque, total = np.square(speed) @ levers(vehicle), speed.sum(axis=1)
    steady = np.ones(len(speed))
    across = (body[:, 1], body[:, 0])
    x, y = (
        np.stack([torque[:, a], across[a] * total, rate[:, a] * total, steady], axis=1)
        for a in (0, 1)
    )
    return x, y, np.stack([torque[:, 2], rate[:, 2] * total, steady], axis=1)

"""The torque that no input shows, as the last samples before a prediction tell it.

Where gusts turn a vehicle its loop answers with its rotors, and a simulation that is fed with these
alone turns against what it does not know. What the angular acceleration was just before a
prediction begins, minus what the model makes of state and inputs, is that torque; of it is carried
on what is usually left so much later: its autocorrelation on fitted flights, the best linear
prediction from one value (Brockwell and Davis, "Time series: theory and methods", 1991, 2.4 and
5.1). Incremental control leans on the same acceleration (Smeur, Chu and de Croon, "Adaptive
incremental nonlinear dynamic inversion for attitude control of micro air vehicles", 2016).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sim_jax.environment import Disturbance
from sim_jax.geometry import Vec3
from tuner.config.job import InletName
from tuner.core.numerics import Array
from tuner.equation_error.model_accelerations import ModelAccelerations
from tuner.equation_error.recorded_accelerations import Steps, steps_fed
from tuner.objective.battery import with_reference_voltage
from tuner.recordings.flight import Flight
from tuner.vehicle import ControllerFile, VehicleFile
from tuner.vehicle.model import model_of, schedule_of

RATE = 100.0
"""Hz of the ticks on which what is left is told."""
LONGEST = 1.0
"""s after which nothing is left."""
TICKS = np.arange(round(LONGEST * RATE) + 1) / RATE

FED = ("rotor_speed", "actuator")
"""Inlets in which recorded rotors or commands turn the vehicle."""
Fed = tuple[Flight, InletName, float]
"""A flight, what of it is fed in, and by how many s that is stamped late."""


@dataclass(frozen=True)
class TorqueObserver:
    """Tells what turns a vehicle unseen.

    Attributes
    ----------
    vehicle, controller
        What is taken off an angular acceleration.
    left
        (T, 3) share of it, about each axis, that is left after `TICKS`.
    """

    vehicle: VehicleFile
    controller: ControllerFile
    left: Array

    @staticmethod
    def of(
        vehicle: VehicleFile, controller: ControllerFile, fitted: Sequence[Fed]
    ) -> TorqueObserver | None:
        """Return the observer of a vehicle fitted to some flights; None if these say nothing."""
        products = np.zeros((len(TICKS), 3))
        for flight in fitted:
            found = _unseen(vehicle, controller, flight)
            if found is None:
                continue
            part, unseen = found
            lags = range(min(len(unseen), round(LONGEST / part.step) + 1))
            rows = [np.sum(unseen[lag:] * unseen[: len(unseen) - lag], axis=0) for lag in lags]
            times = np.array(lags) * part.step
            products += np.stack(
                [np.interp(TICKS, times, row, right=0.0) for row in np.transpose(rows)], axis=1
            )
        if not (products[0] > 0.0).all():
            return None
        left = products / products[0]
        return TorqueObserver(
            vehicle, controller, np.where(np.minimum.accumulate(left) > 0.0, left, 0.0)
        )

    def disturbance(self, fed: Fed, begins: Array) -> Disturbance | None:
        """Return what acts on predictions that begin at (n,) s; None where the flight says nothing.

        Where the last step before is not known, nothing does.
        """
        found = _unseen(self.vehicle, self.controller, fed)
        if found is None:
            return None
        part, unseen = found
        last = np.searchsorted(part.time + 0.5 * part.step, begins + 1e-9) - 1
        torque = np.where(last[:, None] < 0, 0.0, unseen[last])
        inertia = self.vehicle.inertia
        # from the middle of that step; white noise of the gyro is in that step alone
        lag = np.maximum(TICKS + 0.5 * part.step, part.step)
        acting = [
            np.interp(lag, TICKS, self.left[:, axis])[:, None] * moment * torque[:, axis]
            for axis, moment in enumerate((inertia.xx, inertia.yy, inertia.zz))
        ]
        return Disturbance(moment=Vec3(*acting), rate=RATE)


def _unseen(
    vehicle: VehicleFile, controller: ControllerFile, fed: Fed
) -> tuple[Steps, Array] | None:
    """Return a flight's steps, and what of their angular acceleration (N, 3) the model lacks.

    Zero where it is unknown. None where rotors do not turn the vehicle, or too little is known.
    """
    flight, inlet, late = fed
    model = model_of(with_reference_voltage(vehicle, [flight]), controller)
    rate = float(schedule_of(controller).rate_control_rate)
    found = steps_fed(inlet, model, [(flight, late)], rate)
    if found is None:
        return None
    (part,) = found[0]
    (one,) = ModelAccelerations(model, (), (part,)).noiseless.at(np.zeros(0))
    return part, np.where(part.known[:, None], np.nan_to_num(one.left[:, 3:]), 0.0)

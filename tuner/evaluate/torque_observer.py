"""An observer of the disturbance torque just before a prediction begins.

The rotors of a vehicle answer gusts, so that a simulation that is fed with rotor speeds alone turns
against a torque that it does not know. The residual of the model's angular acceleration at the last
step before a prediction shows that torque. It decays in the prediction by its autocorrelation on
fitted flights, which is the best linear prediction from one value (Brockwell and Davis, "Time
series: theory and methods", 1991, 2.4 and 5.1). Incremental control uses the same acceleration
(Smeur, Chu and de Croon, "Adaptive incremental nonlinear dynamic inversion for attitude control of
micro air vehicles", 2016).
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
from tuner.equation_error.recorded_accelerations import Steps, steps_by_inlet
from tuner.objective.battery import with_reference_voltage
from tuner.recordings.flight import Flight
from tuner.vehicle import ControllerFile, VehicleFile
from tuner.vehicle.model import model_of, schedule_of

RATE_HZ = 100.0
"""The rate of the torque in a prediction."""
MAX_LAG_S = 1.0
"""The torque is zero after longer lags."""
LAGS = np.arange(round(MAX_LAG_S * RATE_HZ) + 1) / RATE_HZ

ROTOR_INLETS = ("rotor_speed", "actuator")
"""Inlets with recorded rotor speeds or commands as input."""
FedFlight = tuple[Flight, InletName, float]
"""A flight, its inlet, and the delay in s of the input's stamps."""


@dataclass(frozen=True)
class TorqueObserver:
    """Observes the disturbance torque.

    Attributes
    ----------
    vehicle, controller
        The model whose angular acceleration is subtracted.
    autocorrelation
        (T, 3) of the residual about each axis at `LAGS`.
    """

    vehicle: VehicleFile
    controller: ControllerFile
    autocorrelation: Array

    @staticmethod
    def of(
        vehicle: VehicleFile, controller: ControllerFile, fitted: Sequence[FedFlight]
    ) -> TorqueObserver | None:
        """Return the observer of a vehicle fitted to some flights; None without residuals."""
        products = np.zeros((len(LAGS), 3))
        for flight in fitted:
            found = _residual_acceleration(vehicle, controller, flight)
            if found is None:
                continue
            part, unseen = found
            lags = range(min(len(unseen), round(MAX_LAG_S / part.step) + 1))
            rows = [np.sum(unseen[lag:] * unseen[: len(unseen) - lag], axis=0) for lag in lags]
            times = np.array(lags) * part.step
            products += np.stack(
                [np.interp(LAGS, times, row, right=0.0) for row in np.transpose(rows)], axis=1
            )
        if not (products[0] > 0.0).all():
            return None
        left = products / products[0]
        return TorqueObserver(
            vehicle, controller, np.where(np.minimum.accumulate(left) > 0.0, left, 0.0)
        )

    def disturbance(self, fed: FedFlight, begins: Array) -> Disturbance | None:
        """Return the torque in predictions that begin at (n,) s; None without residuals.

        It is zero if the step before is unknown.
        """
        found = _residual_acceleration(self.vehicle, self.controller, fed)
        if found is None:
            return None
        part, unseen = found
        last = np.searchsorted(part.time + 0.5 * part.step, begins + 1e-9) - 1
        torque = np.where(last[:, None] < 0, 0.0, unseen[last])
        inertia = self.vehicle.inertia
        # lags count from the middle of that step; its white noise of the gyro does not last
        lag = np.maximum(LAGS + 0.5 * part.step, part.step)
        acting = [
            np.interp(lag, LAGS, self.autocorrelation[:, axis])[:, None] * moment * torque[:, axis]
            for axis, moment in enumerate((inertia.xx, inertia.yy, inertia.zz))
        ]
        return Disturbance(moment=Vec3(*acting), rate=RATE_HZ)


def _residual_acceleration(
    vehicle: VehicleFile, controller: ControllerFile, fed: FedFlight
) -> tuple[Steps, Array] | None:
    """Return a flight's steps, and the model's residual angular accelerations (N, 3), rad/s².

    They are zero where unknown. None if the inlet lies above the rotors, or too little is known.
    """
    flight, inlet, late = fed
    model = model_of(with_reference_voltage(vehicle, [flight]), controller)
    rate = float(schedule_of(controller).rate_control_rate)
    found = steps_by_inlet(inlet, model, [(flight, late)], rate)
    if found is None:
        return None
    (part,) = found[0]
    (one,) = ModelAccelerations(model, (), (part,)).at(np.zeros(0))
    return part, np.where(part.known[:, None], np.nan_to_num(one.errors[:, 3:]), 0.0)

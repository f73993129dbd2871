"""Open-loop predictions of a flight from its recorded states and inputs, and their errors.

A prediction begins at a recorded state (`tuner.recordings.states`) and is simulated open loop for a
stated time, with or without an observed disturbance torque. Nothing is fitted to the predicted
flight: no start, no trim, no offset.

The rotors of a vehicle answer gusts, so that a simulation that is fed with rotor speeds alone turns
against a torque that it does not know. The residual of the model's angular acceleration at the last
step before a prediction shows that torque. It decays in the prediction by its autocorrelation on
fitted flights, which is the best linear prediction from one value (Brockwell and Davis, "Time
series: theory and methods", 1991, 2.4 and 5.1). Incremental control uses the same acceleration
(Smeur, Chu and de Croon, "Adaptive incremental nonlinear dynamic inversion for attitude control of
micro air vehicles", 2016).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import stdtrit  # scipy.stats takes a quarter of a second to import

from sim_jax.environment import Disturbance
from sim_jax.geometry import Vec3
from sim_jax.schedule import Schedule
from sim_jax.state import AIRBORNE
from tuner.config import InletName
from tuner.core.numerics import Array
from tuner.equation_error.model_accelerations import ModelAccelerations
from tuner.equation_error.recorded_accelerations import Steps, steps_by_inlet
from tuner.findings.sentences import PREDICTED_UNITS
from tuner.objective.battery import with_reference_voltage
from tuner.objective.criterion import picked
from tuner.objective.inlets import INLETS
from tuner.objective.segments import Segments, commanded_before, cut_windows, window_segments
from tuner.objective.simulation import MOTION, TORQUE_RATE_HZ, fly
from tuner.recordings.flight import Flight
from tuner.recordings.states import States, states_at
from tuner.vehicle import ControllerFile, VehicleFile
from tuner.vehicle.model import Model, model_of, schedule_of

MAX_LAG_S = 1.0
"""The torque is zero after longer lags."""
LAGS = np.arange(round(MAX_LAG_S * TORQUE_RATE_HZ) + 1) / TORQUE_RATE_HZ

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
            residuals = _residual_acceleration(vehicle, controller, flight)
            if residuals is None:
                continue
            part, unseen = residuals
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
        residuals = _residual_acceleration(self.vehicle, self.controller, fed)
        if residuals is None:
            return None
        part, unseen = residuals
        last = np.searchsorted(part.time + 0.5 * part.step, begins + 1e-9) - 1
        torque = np.where(last[:, None] < 0, 0.0, unseen[last])
        inertia = self.vehicle.inertia
        # lags count from the middle of that step; its white noise of the gyro does not last
        lag = np.maximum(LAGS + 0.5 * part.step, part.step)
        acting = [
            np.interp(lag, LAGS, self.autocorrelation[:, axis])[:, None] * moment * torque[:, axis]
            for axis, moment in enumerate((inertia.xx, inertia.yy, inertia.zz))
        ]
        return Disturbance(moment=Vec3(*acting), rate=TORQUE_RATE_HZ)


def _residual_acceleration(
    vehicle: VehicleFile, controller: ControllerFile, fed: FedFlight
) -> tuple[Steps, Array] | None:
    """Return a flight's steps, and the model's residual angular accelerations (N, 3), rad/s².

    They are zero where unknown. None if the inlet lies above the rotors, or too little is known.
    """
    flight, inlet, late = fed
    model = model_of(with_reference_voltage(vehicle, [flight]), controller)
    rate = float(schedule_of(controller).rate_control_rate)
    by_inlet = steps_by_inlet(inlet, model, [(flight, late)], rate)
    if by_inlet is None:
        return None
    (part,) = by_inlet[0]
    (one,) = ModelAccelerations(model, (), (part,)).at(np.zeros(0))
    return part, np.where(part.known[:, None], np.nan_to_num(one.errors[:, 3:]), 0.0)


PREDICTIONS_AT_ONCE = 4096
"""Predictions that are simulated side by side."""
CORRELATION_TIME_S = 2.0
"""Errors of predictions are correlated over so long: they overlap by half a second, and share
disturbances."""


@dataclass(frozen=True)
class Predictions:
    """Predictions of one flight: n from one recorded state each, compared at S steps.

    Attributes
    ----------
    begins
        (n,) s since the mission's start at which they begin.
    ahead
        (S,) s after that at which they are compared.
    errors
        Quantity of `PREDICTED_UNITS` -> (S, n): Euclidean distance from the recorded one, for an
        attitude the angle of the rotation between both. Quantities that are inputs are left out.
    """

    begins: Array
    ahead: Array
    errors: Mapping[str, Array]

    def mean(self, seconds: float) -> dict[str, float]:
        """Return each quantity's mean error so many s ahead; NaN if it is not predicted."""
        step = self._step(seconds)
        means = {name: float(np.nanmean(errors[step])) for name, errors in self.errors.items()}
        return dict.fromkeys(PREDICTED_UNITS, np.nan) | means

    def worse_than(self, other: Predictions, seconds: float) -> tuple[str, ...]:
        """Return the quantities that another predicts significantly better so many s ahead.

        By the test of Diebold and Mariano ("Comparing predictive accuracy", 1995) on differences of
        errors, 95 %: Student's t of means over `CORRELATION_TIME_S`, of which it needs two.
        """
        step = self._step(seconds)
        count = round((self.begins[-1] - self.begins[0]) / CORRELATION_TIME_S)
        if count < 2:
            return ()
        allowed = stdtrit(count - 1, 0.975) / np.sqrt(count)
        worse = []
        for name, errors in self.errors.items():
            apart = errors[step] - other.errors[name][step]
            parts = np.array_split(apart[np.isfinite(apart)], count)
            means = np.array([np.mean(part) for part in parts if len(part)])
            if len(means) == count and np.mean(means) > allowed * np.std(means, ddof=1):
                worse.append(name)
        return tuple(worse)

    def _step(self, seconds: float) -> int:
        (step,) = np.flatnonzero(np.isclose(self.ahead, seconds, atol=1e-6))
        return int(step)


class FlightPredictor:
    """Predicts a flight open loop from many of its recorded states, with any vehicle.

    Parameters
    ----------
    flight, inlet
        The recording and its inlet.
    stride
        s from one prediction to the next.
    seconds
        s that each prediction lasts.
    input_late
        s by which the input is stamped later than the recorded state.

    Raises
    ------
    RecordingError
        The flight never holds so many s of pose and input.
    """

    def __init__(
        self,
        flight: Flight,
        inlet: InletName,
        *,
        stride: float,
        seconds: float = 0.5,
        input_late: float = 0.0,
    ) -> None:
        self.flight, self.inlet, self.seconds = flight, inlet, seconds
        self.input_late = input_late
        self._pieces = cut_windows(
            [flight],
            inlets=[inlet],
            seconds=seconds,
            stride=stride,
            free_starts=False,
            input_late={flight.name: input_late},
        )
        begins = np.array([piece.begin for piece in self._pieces])
        self._whole = np.flatnonzero(begins + seconds <= flight.duration + 1e-9)
        self.begins = begins[self._whole]
        self.ahead = np.arange(1, round(seconds * flight.rate) + 1) / flight.rate
        self._segments: dict[Schedule, Segments] = {}
        self._turning: dict[float, Array] = {}

    @cached_property
    def recorded(self) -> States:
        """The states that predictions are compared with, step by step."""
        return states_at(self.flight.series, (self.begins + self.ahead[:, None]).ravel())

    def predict(
        self,
        vehicle: VehicleFile,
        controller: ControllerFile,
        observer: TorqueObserver | None = None,
    ) -> Predictions:
        """Return the predictions with a vehicle.

        Parameters
        ----------
        vehicle, controller
            The model; the controller gives the rates of the simulation.
        observer
            Gives the disturbance torque at the start of a prediction.
        """
        motor, schedule = vehicle.motor, schedule_of(controller)
        lag = 0.5 * (motor.time_constant_up + motor.time_constant_down)
        if schedule not in self._segments:
            laid = window_segments(
                [self.flight],
                self._pieces,
                inlets=[self.inlet],
                schedule=schedule,
                lag=lag,
                noise={},
                free_starts=False,
            )
            self._segments[schedule] = picked(laid, (..., self._whole))
        if lag not in self._turning:
            self._turning[lag] = commanded_before(self._pieces, lag)[:, self._whole]
        segments = replace(self._segments[schedule], turning=self._turning[lag])
        if observer is not None:
            fed = self.flight, self.inlet, self.input_late
            segments = replace(segments, disturbance=observer.disturbance(fed, self.begins))
        model = model_of(with_reference_voltage(vehicle, [self.flight]), controller)
        reached = _simulated(model, segments, schedule, self.ahead)
        errors = errors_of(reached, self.recorded, (len(self.ahead), len(self.begins)))
        followed = INLETS[self.inlet].not_compared
        predicted = {name: distances for name, distances in errors.items() if name not in followed}
        return Predictions(self.begins, self.ahead, predicted)


def errors_of(
    reached: Mapping[str, Array], recorded: States, shape: tuple[int, int]
) -> dict[str, Array]:
    """Return quantity -> (S, n) distances of reached states (S, n, k) from recorded ones."""
    errors = {}
    for name in PREDICTED_UNITS:
        there = getattr(recorded, name).reshape(*shape, -1)
        if name == "attitude":
            along = np.abs(np.sum(reached[name] * there, axis=-1))
            errors[name] = 2.0 * np.arccos(np.clip(along, 0.0, 1.0))
        else:
            errors[name] = np.linalg.norm(reached[name] - there, axis=-1)
    return errors


def _simulated(
    model: Model, segments: Segments, schedule: Schedule, ahead: Array
) -> dict[str, Array]:
    """Return quantity -> (S, n, k) that the simulations reach so many s (S,) ahead."""
    place = ahead * schedule.log_rate
    below = np.floor(place + 1e-6).astype(int)
    share = (place - below)[:, None, None]

    def at(logged: Array) -> Array:
        before, after = np.moveaxis(logged[:, below], 0, 1), np.moveaxis(logged[:, below + 1], 0, 1)
        return np.asarray(before + share * (after - before))

    parts = []
    for first in range(0, segments.count, PREDICTIONS_AT_ONCE):
        flown = fly(
            model,
            picked(segments, (..., slice(first, first + PREDICTIONS_AT_ONCE))),
            schedule,
            samples=int(np.ceil(place[-1] - 1e-6)) + 2,
            limits=AIRBORNE,
            channels=("position", "attitude", MOTION),
        ).channels
        turned, motion = at(flown["attitude"]), at(flown[MOTION])
        parts.append(
            {
                "position": at(flown["position"]),
                "velocity": motion[..., 3:6],
                "attitude": turned / np.linalg.norm(turned, axis=-1, keepdims=True),
                "body_rate": motion[..., 6:9],
            }
        )
    return {
        name: np.concatenate([part[name] for part in parts], axis=1) for name in PREDICTED_UNITS
    }


def hold_state(
    flight: Flight, begins: Array, ahead: Array, recorded: States | None = None
) -> Predictions:
    """Predict a constant state: the naive predictor.

    ``recorded`` is `FlightPredictor.recorded`, if it is known.
    """
    start = states_at(flight.series, begins)
    reached = {name: getattr(start, name)[None] for name in PREDICTED_UNITS}
    if recorded is None:
        recorded = states_at(flight.series, (begins + ahead[:, None]).ravel())
    return Predictions(begins, ahead, errors_of(reached, recorded, (len(ahead), len(begins))))

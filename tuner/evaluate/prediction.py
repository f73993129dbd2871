"""Open-loop predictions of a flight from its recorded states and inputs, and their errors.

A prediction begins at a recorded state (`tuner.recordings.states`) and is simulated open loop for a
stated time, with or without an observed disturbance torque. Nothing is fitted to the predicted
flight: no start, no trim, no offset.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import jax
import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit  # scipy.stats takes a quarter of a second to import

from sim_jax.schedule import Schedule
from sim_jax.state import AIRBORNE
from tuner.config.job import InletName
from tuner.core.numerics import Array
from tuner.evaluate.torque_observer import TorqueObserver
from tuner.findings.sentences import PREDICTED_UNITS
from tuner.objective.battery import with_reference_voltage
from tuner.objective.inlets import INLETS
from tuner.objective.segments import Segments, cut_windows, window_segments
from tuner.objective.simulation import MOTION, fly
from tuner.recordings.flight import Flight
from tuner.recordings.states import States, states_at
from tuner.vehicle import ControllerFile, VehicleFile
from tuner.vehicle.model import Model, model_of, schedule_of

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


def predict(
    vehicle: VehicleFile,
    controller: ControllerFile,
    flight: Flight,
    inlet: InletName,
    *,
    seconds: float = 0.5,
    stride: float | None = None,
    input_late: float = 0.0,
    observer: TorqueObserver | None = None,
) -> Predictions:
    """Predict a flight open loop from many of its recorded states.

    Parameters
    ----------
    vehicle, controller
        The model; the controller gives the rates of the simulation.
    flight, inlet
        The recording and its inlet.
    seconds
        s that each prediction lasts.
    stride
        s from one prediction to the next; by default one sample.
    input_late
        s by which the input is stamped later than the recorded state.
    observer
        Gives the disturbance torque at the start of a prediction.

    Raises
    ------
    RecordingError
        The flight never holds so many s of pose and input.
    """
    predictor = FlightPredictor(
        flight, inlet, seconds=seconds, stride=stride, input_late=input_late
    )
    return predictor.predict(vehicle, controller, observer)


class FlightPredictor:
    """Predicts one flight from the same states with any vehicle.

    Parameters, units and errors are those of `predict`.
    """

    def __init__(
        self,
        flight: Flight,
        inlet: InletName,
        *,
        seconds: float = 0.5,
        stride: float | None = None,
        input_late: float = 0.0,
    ) -> None:
        self.flight, self.inlet, self.seconds = flight, inlet, seconds
        self.input_late = input_late
        self._pieces = cut_windows(
            [flight],
            inlets=[inlet],
            seconds=seconds,
            stride=1.0 / flight.rate if stride is None else stride,
            free_starts=False,
            input_late={flight.name: input_late},
        )
        begins = np.array([piece.window.begin for piece in self._pieces])
        self._whole = np.flatnonzero(begins + seconds <= flight.duration + 1e-9)
        self.begins = begins[self._whole]
        self.ahead = np.arange(1, round(seconds * flight.rate) + 1) / flight.rate

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
        """Return the predictions with a vehicle."""
        motor, schedule = vehicle.motor, schedule_of(controller)
        segments = window_segments(
            [self.flight],
            self._pieces,
            inlets=[self.inlet],
            schedule=schedule,
            lag=0.5 * (motor.time_constant_up + motor.time_constant_down),
            noise={},
            free_starts=False,
        )
        segments = _select(segments, self._whole)
        if observer is not None:
            known = self.flight, self.inlet, self.input_late
            segments = replace(segments, disturbance=observer.disturbance(known, self.begins))
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
            _select(segments, np.arange(first, min(first + PREDICTIONS_AT_ONCE, segments.count))),
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


def _select(segments: Segments, chosen: NDArray[np.intp]) -> Segments:
    """Return some of the segments, which lie along the last axis."""
    taken: Segments = jax.tree.map(lambda leaf: leaf[..., chosen], segments)
    return taken


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

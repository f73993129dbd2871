"""How well a flight is predicted by the initial and the fitted vehicle, and how well it is met.

Predictions begin at recorded states and nothing is fitted to the flight that is predicted; what is
fitted to it, the starts of windows and their trims, makes another number with another name.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from tuner.core.findings import Code, Finding
from tuner.evaluate.best_fit import comparison_of, controller_flown
from tuner.evaluate.predict import UNITS, Predictions, hold, predict
from tuner.evaluate.rmse import FlightErrors, Pose, PredictedErrors
from tuner.objective.inlets import INLETS
from tuner.recordings.flight import Flight
from tuner.search.fitted import Fitted
from tuner.search.problem import Job
from tuner.vehicle import VehicleFile

AHEAD = (0.1, 0.5)
"""s after which predictions are compared."""
STRIDE = 0.1
"""s from one prediction to the next."""


@dataclass(frozen=True)
class Validation:
    """Flight -> how well it is simulated, with the initial and with the fitted vehicle.

    Attributes
    ----------
    initial, best
        Whole in the closed loop, else in windows from recorded states.
    fitted_starts
        As ``best``, but windows start where the vehicle meets them best; flights in windows only.
    predicted_initial, predicted_best
        Open-loop predictions; flights in windows only.
    predicted_holding
        That the state stays as it was recorded, at the times of these predictions.
    turning_explained
        Share of the squared change of body rate that the fitted vehicle predicts; flights in
        windows only.
    """

    initial: Mapping[str, FlightErrors]
    best: Mapping[str, FlightErrors]
    fitted_starts: Mapping[str, FlightErrors] = field(default_factory=dict)
    predicted_initial: Mapping[str, tuple[PredictedErrors, ...]] = field(default_factory=dict)
    predicted_best: Mapping[str, tuple[PredictedErrors, ...]] = field(default_factory=dict)
    predicted_holding: Mapping[str, tuple[PredictedErrors, ...]] = field(default_factory=dict)
    turning_explained: Mapping[str, float] = field(default_factory=dict)


def validate(job: Job, fitted: Fitted, vehicle: VehicleFile) -> Validation:
    """Fly every flight with the initial and with the fitted vehicle."""
    comparison, initial = comparison_of(job, fitted), job.given.vehicle
    predictions = _predictions(job, fitted, vehicle)
    return Validation(
        initial=comparison.fly(initial),
        best=comparison.fly(vehicle),
        fitted_starts=comparison.fly_from_fitted_starts(vehicle),
        predicted_initial=_errors(_predictions(job, fitted, initial)),
        predicted_best=_errors(predictions),
        predicted_holding=_errors(_held(job, predictions)),
        turning_explained={
            recording.flight.name: _turning_explained(recording.flight, predicted)
            for recording in job.recordings
            if (predicted := predictions.get(recording.flight.name))
            and "body_rate" in predicted.errors
        },
    )


def _predictions(job: Job, fitted: Fitted, vehicle: VehicleFile) -> dict[str, Predictions]:
    """Return flight -> its predictions, of those that are not flown in a closed loop."""
    controller, predicted = controller_flown(job, fitted), {}
    for recording in job.recordings:
        if INLETS[recording.inlet].closed_loop:
            continue
        predicted[recording.flight.name] = predict(
            vehicle,
            controller,
            recording.flight,
            recording.inlet,
            seconds=max(AHEAD),
            stride=STRIDE,
            input_late=recording.input_late,
        )
    return predicted


def _held(job: Job, predictions: Mapping[str, Predictions]) -> dict[str, Predictions]:
    """Return flight -> what is off if its state stays, of what its predictions predict."""
    held = {}
    for flight in job.flights:
        if (of := predictions.get(flight.name)) is not None:
            naive = hold(flight, of.begins, of.ahead)
            same = {name: naive.errors[name] for name in of.errors}
            held[flight.name] = replace(naive, errors=same)
    return held


def _errors(
    predictions: Mapping[str, Predictions],
) -> dict[str, tuple[PredictedErrors, ...]]:
    return {
        name: tuple(PredictedErrors(seconds=seconds, **of.mean(seconds)) for seconds in AHEAD)
        for name, of in predictions.items()
    }


def _turning_explained(flight: Flight, predictions: Predictions) -> float:
    naive = hold(flight, predictions.begins, predictions.ahead)
    squares = [float(np.nanmean(of.errors["body_rate"][-1] ** 2)) for of in (predictions, naive)]
    return 1.0 - squares[0] / squares[1]


WORSE = 0.01
"""Share by which a flight may be met worse than before the fit without a word."""


MET_BY: Mapping[Pose, str] = {"position": "m", "attitude": "degrees"}
"""What a flight is judged by, with its unit."""


def flights_worse(
    initial: Mapping[str, FlightErrors], best: Mapping[str, FlightErrors]
) -> tuple[Finding, ...]:
    """Return which flights the fitted coefficients meet worse than the initial ones, or crash.

    Parameters
    ----------
    initial, best
        Flight -> errors of a simulation with the initial, and with the fitted coefficients.
    """
    findings = []
    for flight in best:
        crashed = best[flight].crash_time
        if crashed is not None:
            if initial[flight].crash_time is None:
                numbers = {"seconds": crashed}
                findings.append(Finding(Code.FLIGHT_CRASHES, "warning", flight, numbers))
            continue
        for what, unit in MET_BY.items():
            before, after = initial[flight].length(what), best[flight].length(what)
            if after > (1.0 + WORSE) * before:
                numbers = {"before": before, "after": after}
                findings.append(
                    Finding(Code.FLIGHT_WORSE, "warning", flight, numbers, (what, unit))
                )
    return tuple(findings)


def holding_better(job: Job, validation: Validation) -> tuple[Finding, ...]:
    """Return what of a flight is predicted no better than by leaving it as it is, in the mean."""
    findings = []
    for recording in job.recordings:
        name = recording.flight.name
        pairs = zip(
            validation.predicted_best.get(name, ()),
            validation.predicted_holding.get(name, ()),
            strict=True,
        )
        for best, held in pairs:
            numbers = {"seconds": best.seconds}
            for quantity in UNITS:
                of_best, of_held = getattr(best, quantity), getattr(held, quantity)
                if of_best is not None and of_held is not None and of_best > of_held:
                    numbers |= {quantity: of_best, f"{quantity}_held": of_held}
            lost = tuple(quantity for quantity in UNITS if quantity in numbers)
            if lost:
                findings.append(Finding(Code.HOLDING_BETTER, "warning", name, numbers, lost))
    return tuple(findings)

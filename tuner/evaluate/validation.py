"""Validation: errors of flights with the initial and with the fitted vehicle.

Predictions begin at recorded states, and nothing is fitted to the predicted flight. Errors with
fitted starts and trims of windows have a name of their own.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from tuner.core.numerics import Array
from tuner.evaluate.comparison import Comparison, FlightErrors, Pose
from tuner.evaluate.prediction import (
    ROTOR_INLETS,
    FlightPredictor,
    TorqueObserver,
    hold_state,
)
from tuner.evaluate.records import PredictedErrors
from tuner.findings.findings import Code, Finding
from tuner.objective.inlets import INLETS, linear_interpolation
from tuner.recordings.flight import Flight
from tuner.search.job_flights import with_known
from tuner.search.problem import Job
from tuner.search.progress import (
    Fit,
    conditions_of,
    controller_flown,
    offsets_of,
    vehicle_fitted,
)
from tuner.vehicle.controller import PositionControl


def comparison_of(job: Job, fitted: Fit) -> Comparison:
    """Return the comparison of a job with the fitted controller, clocks and conditions."""
    recordings = with_known(
        job.recordings, time_offset=offsets_of(job, fitted), conditions=conditions_of(job, fitted)
    )
    window = job.settings.job.search.window
    return Comparison(recordings, controller_flown(job, fitted), window=window)


HORIZONS_S = (0.1, 0.5)
"""Times ahead at which predictions are compared."""
STRIDE_S = 0.1


@dataclass(frozen=True)
class Validation:
    """Flight -> errors of its simulation with the initial and with the fitted vehicle.

    Attributes
    ----------
    initial, best
        Of whole flights in the closed loop, else of windows from recorded states.
    fitted_starts
        As ``best``, with fitted starts of windows; flights in windows only.
    predicted
        Predictor -> mean errors of open-loop predictions; flights in windows only. The predictors
        are the ``initial`` and the fitted (``best``) vehicle, the latter ``with_observer`` of the
        disturbance torque where rotor signals are fed in, and ``holding``: a constant state.
    worse_than_holding
        s ahead -> quantities that the fitted vehicle predicts significantly worse than holding.
    turning_explained
        Share of the mean squared change of body rate that the fitted vehicle predicts; flights
        in windows only.
    """

    initial: Mapping[str, FlightErrors]
    best: Mapping[str, FlightErrors]
    fitted_starts: Mapping[str, FlightErrors] = field(default_factory=dict)
    predicted: dict[str, dict[str, tuple[PredictedErrors, ...]]] = field(default_factory=dict)
    worse_than_holding: dict[str, Mapping[float, tuple[str, ...]]] = field(default_factory=dict)
    turning_explained: dict[str, float] = field(default_factory=dict)


def validate(job: Job, fitted: Fit) -> Validation:
    """Fly every flight with the initial and with the fitted vehicle."""
    comparison, controller = comparison_of(job, fitted), controller_flown(job, fitted)
    vehicle = vehicle_fitted(job, fitted)
    validation = Validation(
        initial=comparison.fly(job.user_settings.vehicle),
        best=comparison.fly(vehicle, forces=True),
        fitted_starts=comparison.fly(vehicle, fitted_starts=True),
    )
    fitted_flights = [(r.flight, r.inlet, r.input_late) for r in job.recordings if not r.holdout]
    observer = TorqueObserver.of(vehicle, controller, fitted_flights)
    for recording in job.recordings:
        if INLETS[recording.inlet].closed_loop:
            continue
        name = recording.flight.name
        predictor = FlightPredictor(
            recording.flight,
            recording.inlet,
            seconds=max(HORIZONS_S),
            stride=STRIDE_S,
            input_late=recording.input_late,
        )
        best = predictor.predict(vehicle, controller)
        held = hold_state(predictor.flight, predictor.begins, predictor.ahead, predictor.recorded)
        held = replace(held, errors={quantity: held.errors[quantity] for quantity in best.errors})
        predicted = {
            "initial": predictor.predict(job.user_settings.vehicle, controller),
            "best": best,
            "holding": held,
        }
        if observer is not None and recording.inlet in ROTOR_INLETS:
            predicted["with_observer"] = predictor.predict(vehicle, controller, observer)
        validation.predicted[name] = {
            kind: tuple(PredictedErrors(seconds=at, **of.mean(at)) for at in HORIZONS_S)
            for kind, of in predicted.items()
        }
        validation.worse_than_holding[name] = {
            seconds: best.worse_than(held, seconds) for seconds in HORIZONS_S
        }
        if "body_rate" in best.errors:
            left, turned = (np.nanmean(of.errors["body_rate"][-1] ** 2) for of in (best, held))
            validation.turning_explained[name] = 1.0 - float(left) / float(turned)
    return validation


MAX_RMSE_INCREASE = 0.01
"""A flight's RMSE may grow by this share in the fit without a finding."""

UNITS: Mapping[Pose, str] = {"position": "m", "attitude": "degrees"}


def flights_worse(
    initial: Mapping[str, FlightErrors], best: Mapping[str, FlightErrors]
) -> Iterator[Finding]:
    """Return findings on flights with larger RMSE after the fit, or that crash.

    Parameters
    ----------
    initial, best
        Flight -> errors of a simulation with the initial, and with the fitted coefficients.
    """
    for flight in best:
        crashed = best[flight].crash_time
        if crashed is not None:
            if initial[flight].crash_time is None:
                yield Code.FLIGHT_CRASHES.warning(flight, seconds=crashed)
            continue
        for what, unit in UNITS.items():
            before, after = (initial[flight].rmse.norm(what), best[flight].rmse.norm(what))
            if after > (1.0 + MAX_RMSE_INCREASE) * before:
                yield Code.FLIGHT_WORSE.warning(flight, what, unit, before=before, after=after)


ODD_RATIO, ODD_RMSE_M = 5.0, 0.05
"""A position RMSE above so many times the others' median, and above so much, is odd."""
MIN_SHARE_AT_LIMIT = 0.05
"""The simulation must be at the limit of position control for so much longer, as a share."""


def flights_not_followed(job: Job, errors: Mapping[str, FlightErrors]) -> Iterator[Finding]:
    """Return findings on flights that the closed loop does not follow although it follows others.

    They have the time of departure, and the shares of time with position feedback above its limit,
    simulated and recorded. Above the limit the loop cannot return: a rotor with a few percent less
    thrust keeps a fast flight there for good, while an error of the start decays in seconds.

    Parameters
    ----------
    job
        Its fitted and held-out flights, and its controller.
    errors
        Flight -> errors of a simulation with the fitted coefficients.
    """
    flown = {
        r.flight.name: r.flight
        for r in job.recordings
        if INLETS[r.inlet].closed_loop
        and not r.flight.spins_freely
        and errors[r.flight.name].crash_time is None
    }
    lengths = {name: errors[name].rmse.norm("position") for name in flown}
    for name, flight in flown.items():
        others = [length for other, length in lengths.items() if other != name]
        typical = float(np.median(others)) if len(others) > 1 else np.inf
        if lengths[name] < max(ODD_RATIO * typical, ODD_RMSE_M):
            continue
        position = errors[name].position
        away = np.linalg.norm(np.nan_to_num(position.error), axis=1) > max(
            ODD_RATIO * typical, ODD_RMSE_M
        )
        numbers = {
            "rmse": lengths[name],
            "others": typical,
            "seconds": float(position.time[int(np.argmax(away))]),
        }
        shares = [
            _beyond_limit(flight, job.settings.controller.position, position.time, there)
            for there in (position.simulated, position.recorded)
        ]
        if shares[0] > shares[1] + MIN_SHARE_AT_LIMIT:
            numbers |= {"beyond": shares[0], "beyond_recorded": shares[1]}
        yield Code.FLIGHT_NOT_FLOWN.warning(name, **numbers)


def _beyond_limit(flight: Flight, control: PositionControl, time: Array, position: Array) -> float:
    """Return the share of a flight with position feedback above its limit."""
    feedback = np.zeros_like(position)
    for kind, gains, there in (
        ("position", control.kp, position),
        ("velocity", control.kv, np.gradient(position, time, axis=0)),
    ):
        series = flight.series.get(f"reference_{kind}")
        if series is None:
            return 0.0
        feedback += np.array(gains) * (linear_interpolation(series, time) - there)
    limit = control.max_feedback_acceleration
    return float(np.mean(np.linalg.norm(feedback, axis=1) > limit))


def predicted_worse_than_held(job: Job, validation: Validation) -> Iterator[Finding]:
    """Return findings on flights that are predicted significantly worse than by a constant state.

    They are for the longest such time ahead.
    """
    for recording in job.recordings:
        name = recording.flight.name
        ahead = validation.worse_than_holding.get(name, {})
        worse = {seconds: names for seconds, names in ahead.items() if names}
        if not worse:
            continue
        seconds = max(worse)
        best, held = (
            next(one for one in validation.predicted[name][kind] if one.seconds == seconds)
            for kind in ("best", "holding")
        )
        errors = {
            f"{quantity}{suffix}": getattr(of, quantity)
            for quantity in worse[seconds]
            for suffix, of in (("", best), ("_held", held))
        }
        yield Code.HOLDING_BETTER.warning(
            name, *worse[seconds], soonest=min(worse), seconds=seconds, **errors
        )

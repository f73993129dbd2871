"""How well a flight is predicted by the initial and the fitted vehicle, and how well it is met.

Predictions begin at recorded states and nothing is fitted to the flight that is predicted; what is
fitted to it, the starts of windows and their trims, makes another number with another name.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from tuner.core.numerics import Array
from tuner.evaluate.comparison import Comparison
from tuner.evaluate.prediction import Course, Predictions, hold
from tuner.evaluate.records import PredictedErrors
from tuner.evaluate.rmse import FlightErrors, Pose
from tuner.evaluate.torque_observer import FED, TorqueObserver
from tuner.findings.findings import Code, Finding
from tuner.objective.criterion import OFFSET_UNIT, units_of
from tuner.objective.inlets import INLETS
from tuner.objective.segments import CLOCKS, OFFSETS
from tuner.recordings.flight import Flight
from tuner.search.iteration import PointEstimate
from tuner.search.job_flights import with_known
from tuner.search.problem import Job
from tuner.search.progress import Fitted, loop_of
from tuner.vehicle import COEFFICIENTS, ControllerFile, VehicleFile, initial_values, with_values
from tuner.vehicle.controller import PositionControl


def controller_flown(job: Job, fitted: Fitted) -> ControllerFile:
    """Return the controller file with the choices of the loop that the search ended with."""
    controller, loop = job.settings.controller, loop_of(fitted.objective)
    return controller.replace(
        mixer=controller.mixer.replace(saturation_feedback=loop.saturation_feedback > 0.5),
        sensing=controller.sensing.replace(sees_markers=loop.sees_markers > 0.5),
    )


def vehicle_fitted(job: Job, fitted: Fitted) -> VehicleFile:
    """Return the vehicle with the best coefficients, see `best_values`."""
    return with_values(job.settings.vehicle, best_values(job, fitted))


def best_values(job: Job, fitted: Fitted) -> dict[str, float]:
    """Return each free coefficient's reported value: fitted, or initial for one that is held."""
    initial, values = initial_of(job), job.space.numbers(fitted.point.coefficients)
    tied = (p.ratios for p in job.space.parameters if p.name in fitted.held.values())
    held = {*impossible_inertia(job, fitted), *(name for ratios in tied for name in ratios)}
    return {name: initial[name] if name in held else v for name, v in values.items()}


def point_estimates(job: Job, fitted: Fitted) -> tuple[PointEstimate, ...]:
    """Return each free coefficient's initial and reported value."""
    initial = initial_of(job)
    return tuple(
        PointEstimate(
            name=name, unit=COEFFICIENTS[name].unit, initial=initial[name], estimate=estimate
        )
        for name, estimate in best_values(job, fitted).items()
    )


def initial_of(job: Job) -> dict[str, float]:
    """Return every coefficient's initial value."""
    return initial_values(job.settings.vehicle, job.settings.controller, job.space.free)


def impossible_inertia(job: Job, fitted: Fitted) -> tuple[str, ...]:
    """Return the fitted moments of inertia, if together they are no rigid body's."""
    fit, initial = job.space.numbers(fitted.point.coefficients), initial_of(job)
    inertia = [name for name, row in COEFFICIENTS.items() if row.place[0] == "inertia"]
    moments = {name: fit.get(name, initial[name]) for name in inertia}
    if 2 * max(moments.values()) <= sum(moments.values()):
        return ()
    return tuple(name for name in inertia if name in fit)


def offsets_of(job: Job, fitted: Fitted) -> dict[str, float]:
    """Return flight -> s by which its pose stamps are late."""
    pose = np.asarray(fitted.point.offsets)[CLOCKS.index("pose")] * OFFSET_UNIT
    offsets = {recording.flight.name: recording.time_offset or 0.0 for recording in job.recordings}
    for flight, late in zip(job.fitted, pose, strict=True):
        offsets[flight.name] += float(late)
    return offsets


def conditions_of(job: Job, fitted: Fitted) -> dict[str, dict[str, float]]:
    """Return flight -> name -> what surrounded it.

    It was estimated of the fitted flights; those held out are predicted with their mean.
    """
    names = fitted.objective.conditions
    rows = np.asarray(fitted.point.offsets)[len(OFFSETS) :] * units_of(names)[:, None]
    usual = dict(zip(names, rows.mean(axis=1).tolist(), strict=True))
    conditions = {recording.flight.name: usual for recording in job.recordings}
    for flight, values in zip(job.fitted, rows.T.tolist(), strict=True):
        conditions[flight.name] = dict(zip(names, values, strict=True))
    return conditions


def comparison_of(job: Job, fitted: Fitted) -> Comparison:
    """Return the job's recordings laid out as the search ended: controller, clocks, air."""
    recordings = with_known(
        job.recordings, time_offset=offsets_of(job, fitted), conditions=conditions_of(job, fitted)
    )
    window = job.settings.job.search.window
    return Comparison(recordings, controller_flown(job, fitted), window=window)


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
    predicted_with_observer
        Likewise by the fitted vehicle, with the torque that fed rotors do not show before them.
    predicted_holding
        That the state stays as it was recorded, at the times of these predictions.
    worse_than_holding
        s ahead -> the quantities that the fitted vehicle predicts worse than that, chance apart.
    turning_explained
        Share of the squared change of body rate that the fitted vehicle predicts; flights in
        windows only.
    """

    initial: Mapping[str, FlightErrors]
    best: Mapping[str, FlightErrors]
    fitted_starts: Mapping[str, FlightErrors] = field(default_factory=dict)
    predicted_initial: Mapping[str, tuple[PredictedErrors, ...]] = field(default_factory=dict)
    predicted_best: Mapping[str, tuple[PredictedErrors, ...]] = field(default_factory=dict)
    predicted_with_observer: Mapping[str, tuple[PredictedErrors, ...]] = field(default_factory=dict)
    predicted_holding: Mapping[str, tuple[PredictedErrors, ...]] = field(default_factory=dict)
    worse_than_holding: Mapping[str, Mapping[float, tuple[str, ...]]] = field(default_factory=dict)
    turning_explained: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class _Predicted:
    """Predictions of one flight; ``observed`` where an observer can tell something of it."""

    initial: Predictions
    best: Predictions
    held: Predictions
    observed: Predictions | None


def validate(job: Job, fitted: Fitted, vehicle: VehicleFile) -> Validation:
    """Fly every flight with the initial and with the fitted vehicle."""
    comparison, initial = comparison_of(job, fitted), job.given.vehicle
    predicted = _predicted(job, fitted, vehicle)
    return Validation(
        initial=comparison.fly(initial),
        best=comparison.fly(vehicle),
        fitted_starts=comparison.fly(vehicle, fitted_starts=True),
        predicted_initial={name: _errors(of.initial) for name, of in predicted.items()},
        predicted_best={name: _errors(of.best) for name, of in predicted.items()},
        predicted_with_observer={
            name: _errors(of.observed) for name, of in predicted.items() if of.observed is not None
        },
        predicted_holding={name: _errors(of.held) for name, of in predicted.items()},
        worse_than_holding={
            name: {seconds: of.best.worse_than(of.held, seconds) for seconds in AHEAD}
            for name, of in predicted.items()
        },
        turning_explained={
            name: 1.0 - _turning_missed(of.best) / _turning_missed(of.held)
            for name, of in predicted.items()
            if "body_rate" in of.best.errors
        },
    )


def _predicted(job: Job, fitted: Fitted, vehicle: VehicleFile) -> dict[str, _Predicted]:
    """Return flight -> its predictions, of those that are not flown in a closed loop."""
    controller = controller_flown(job, fitted)
    known = [(r.flight, r.inlet, r.input_late) for r in job.recordings if not r.holdout]
    observer = TorqueObserver.of(vehicle, controller, known)
    found = {}
    for recording in job.recordings:
        if INLETS[recording.inlet].closed_loop:
            continue
        course = Course(
            recording.flight,
            recording.inlet,
            seconds=max(AHEAD),
            stride=STRIDE,
            input_late=recording.input_late,
        )
        best = course.predicted(vehicle, controller)
        observes = observer is not None and recording.inlet in FED
        found[recording.flight.name] = _Predicted(
            initial=course.predicted(job.given.vehicle, controller),
            best=best,
            held=_unchanged(course, best),
            observed=course.predicted(vehicle, controller, observer) if observes else None,
        )
    return found


def _unchanged(course: Course, predictions: Predictions) -> Predictions:
    """Return what is off if a flight's state stays, of what predictions of it predict."""
    naive = hold(course.flight, course.begins, course.ahead, course.recorded)
    return replace(naive, errors={name: naive.errors[name] for name in predictions.errors})


def _errors(of: Predictions) -> tuple[PredictedErrors, ...]:
    return tuple(PredictedErrors(seconds=seconds, **of.mean(seconds)) for seconds in AHEAD)


def _turning_missed(predictions: Predictions) -> float:
    """Return the mean square by which the body rate is missed at the end of predictions."""
    return float(np.nanmean(predictions.errors["body_rate"][-1] ** 2))


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
            before, after = initial[flight].rmse.length(what), best[flight].rmse.length(what)
            if after > (1.0 + WORSE) * before:
                numbers = {"before": before, "after": after}
                findings.append(
                    Finding(Code.FLIGHT_WORSE, "warning", flight, numbers, (what, unit))
                )
    return tuple(findings)


ODD, FAR = 5.0, 0.05
"""Times the middle of the others, and m, from which a flight's position RMSE stands out."""
AT_LIMIT = 0.05
"""Share of a flight by which the simulated one is longer at the limit of position control."""


def flights_not_flown(job: Job, errors: Mapping[str, FlightErrors]) -> tuple[Finding, ...]:
    """Return which flights the closed loop does not follow although it follows others.

    With the time from which, and how long position control asks for more than its limit, in the
    simulation and in the recording. Beyond that limit it leans on a loop that knows no way back: a
    start that is off is forgotten in seconds, and a rotor that lifts a few percent less keeps a
    fast flight there for good.

    Parameters
    ----------
    job
        Its flights, fitted ones and those held out, and its controller.
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
    lengths = {name: errors[name].rmse.length("position") for name in flown}
    findings = []
    for name, flight in flown.items():
        others = [length for other, length in lengths.items() if other != name]
        typical = float(np.median(others)) if len(others) > 1 else np.inf
        if lengths[name] < max(ODD * typical, FAR):
            continue
        position = errors[name].position
        away = np.linalg.norm(np.nan_to_num(position.error), axis=1) > max(ODD * typical, FAR)
        numbers = {
            "rmse": lengths[name],
            "others": typical,
            "seconds": float(position.time[int(np.argmax(away))]),
        }
        shares = [
            _beyond_limit(flight, job.settings.controller.position, position.time, there)
            for there in (position.simulated, position.recorded)
        ]
        if shares[0] > shares[1] + AT_LIMIT:
            numbers |= {"beyond": shares[0], "beyond_recorded": shares[1]}
        findings.append(Finding(Code.FLIGHT_NOT_FLOWN, "warning", name, numbers))
    return tuple(findings)


def _beyond_limit(flight: Flight, control: PositionControl, time: Array, position: Array) -> float:
    """Return the share of a flight in which the feedback asked for is longer than its limit."""
    asked = np.zeros_like(position)
    for kind, gains, there in (
        ("position", control.kp, position),
        ("velocity", control.kv, np.gradient(position, time, axis=0)),
    ):
        series = flight.series.get(f"reference_{kind}")
        if series is None:
            return 0.0
        wanted = [np.interp(time, series.time, column) for column in series.values.T]
        asked += np.array(gains) * (np.column_stack(wanted) - there)
    limit = control.max_feedback_acceleration
    return float(np.mean(np.linalg.norm(asked, axis=1) > limit))


def holding_better(job: Job, validation: Validation) -> tuple[Finding, ...]:
    """Return what of a flight is predicted worse than by leaving it as it is, chance apart.

    So far ahead as anything is.
    """
    findings = []
    for recording in job.recordings:
        name = recording.flight.name
        ahead = validation.worse_than_holding.get(name, {})
        lost = {seconds: names for seconds, names in ahead.items() if names}
        if not lost:
            continue
        seconds = max(lost)
        best, held = (
            next(one for one in predicted[name] if one.seconds == seconds)
            for predicted in (validation.predicted_best, validation.predicted_holding)
        )
        numbers = {"soonest": min(lost), "seconds": seconds}
        for quantity in lost[seconds]:
            numbers |= {
                quantity: getattr(best, quantity),
                f"{quantity}_held": getattr(held, quantity),
            }
        findings.append(Finding(Code.HOLDING_BETTER, "warning", name, numbers, lost[seconds]))
    return tuple(findings)

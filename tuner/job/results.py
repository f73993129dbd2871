"""A finished search into the result folder: what was found, how well it is met, how sure it is."""

from __future__ import annotations

import csv
import io
import platform
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np
from pydantic import JsonValue

from tuner.coefficients import COEFFICIENTS
from tuner.comparison.comparison import Comparison
from tuner.comparison.errors import FlightErrors
from tuner.config import (
    ControllerFile,
    VehicleFile,
    initial_values,
    with_values,
    write_vehicle,
)
from tuner.disk import write_text
from tuner.flights.flight import Flight
from tuner.job.prepare import Job
from tuner.objective.criterion import OFFSET_UNIT
from tuner.objective.initial_conditions import STATES
from tuner.objective.segments import CLOCKS, OFFSETS
from tuner.recordings import with_offsets
from tuner.result import (
    BEST_FIT_FILE,
    SCHEMA_VERSION,
    AxesRmse,
    CoefficientResult,
    Ending,
    FlightResult,
    RunResult,
    SearchResult,
    Status,
    write_result,
)
from tuner.search.fitted import Fitted
from tuner.uncertainty.estimates import Uncertainty
from tuner.uncertainty.verdict import (
    NOT_FITTED,
    Verdict,
    judge_after_holding,
    judge_impossible_inertia,
)
from tuner.wording.verdicts import judgement_in_words

METRICS_FILE = "metrics.csv"
LIBRARIES = ("multirotor-tune", "jax", "jaxlib", "equinox", "optimistix", "numpy", "rosbags")
UNITS = {"x": "m", "y": "m", "z": "m", "roll": "deg", "pitch": "deg", "yaw": "deg"}


def controller_flown(job: Job, fitted: Fitted) -> ControllerFile:
    """Return the controller file with what the search found out about the set-up."""
    said = job.settings.controller
    feedback = bool(fitted.objective.model.controller.rate.saturation_feedback > 0.5)
    return said.replace(mixer=said.mixer.replace(saturation_feedback=feedback))


def vehicle_fitted(job: Job, fitted: Fitted) -> VehicleFile:
    """Return the vehicle with the best coefficients.

    A coefficient that the flights do not determine keeps its initial value.
    """
    return with_values(job.settings.vehicle, best_values(job, fitted))


def best_values(job: Job, fitted: Fitted) -> dict[str, float]:
    """Return the coefficients that are reported: the fitted ones, but for those that are held."""
    start = _initial(job)
    found = job.space.values(fitted.point.coefficients)
    kept = {*impossible(job, fitted), *_held(job, fitted)}
    return {name: start[name] if name in kept else float(value) for name, value in found.items()}


def _initial(job: Job) -> dict[str, float]:
    return initial_values(job.settings.vehicle, job.settings.controller, job.space.free)


def _held(job: Job, fitted: Fitted) -> frozenset[str]:
    """Return the coefficients that were held at their initial values, tied ones too."""
    held = set(fitted.held.values())
    groups = (p.ratios for p in job.space.parameters if p.name in held)
    return frozenset(name for ratios in groups for name in ratios)


def impossible(job: Job, fitted: Fitted) -> tuple[str, ...]:
    """Return the fitted moments of inertia, if together they are no rigid body's."""
    found = job.space.values(fitted.point.coefficients)
    start = _initial(job)
    inertia = [name for name, row in COEFFICIENTS.items() if row.place[0] == "inertia"]
    moments = {name: float(found.get(name, start[name])) for name in inertia}
    if 2 * max(moments.values()) <= sum(moments.values()):
        return ()
    return tuple(name for name in inertia if name in found)


def offsets_of(job: Job, fitted: Fitted) -> dict[str, float]:
    """Return flight -> s by which its pose stamps are late."""
    pose = np.asarray(fitted.point.offsets)[CLOCKS.index("pose")] * OFFSET_UNIT
    found = {recording.flight.name: recording.time_offset or 0.0 for recording in job.recordings}
    for flight, late in zip(job.fitted, pose, strict=True):
        found[flight.name] += float(late)
    return found


def offsets_by_flight(job: Job, fitted: Fitted) -> dict[str, JsonValue]:
    """Return flight -> what it was found to get wrong by a constant, in s and rad/s."""
    table = np.asarray(fitted.point.offsets) * OFFSET_UNIT
    return {
        flight.name: dict(zip(OFFSETS, table[:, number].tolist(), strict=True))
        for number, flight in enumerate(job.fitted)
    }


def starts_moved(fitted: Fitted) -> dict[str, JsonValue]:
    """Return what windows' free starts were moved by, root mean square; empty for whole flights.

    Name of `STATES` -> in its unit there: how much was given to nuisances, not to coefficients.
    """
    freedom, states = fitted.objective.segments.freedom, fitted.criterion.states
    if freedom is None or states is None:
        return {}
    moved, found, first = np.asarray(states) * np.asarray(freedom), dict[str, JsonValue](), 0
    for name, (count, _) in STATES.items():
        found[name] = float(np.sqrt(np.mean(moved[first : first + count] ** 2)))
        first += count
    return found


def comparison_of(job: Job, fitted: Fitted) -> Comparison:
    """Return the job's recordings laid out as the search ended: controller and clocks."""
    recordings = with_offsets(job.recordings, offsets_of(job, fitted))
    window = job.settings.job.search.window
    return Comparison(recordings, controller_flown(job, fitted), window=window)


def validate(
    job: Job, fitted: Fitted, vehicle: VehicleFile
) -> tuple[dict[str, FlightErrors], dict[str, FlightErrors]]:
    """Fly every flight whole with the initial and with the fitted vehicle."""
    comparison = comparison_of(job, fitted)
    return comparison.fly(job.settings.vehicle), comparison.fly(vehicle)


def result_of(
    job: Job,
    fitted: Fitted,
    uncertainty: Uncertainty,
    errors: tuple[Mapping[str, FlightErrors], Mapping[str, FlightErrors]],
    *,
    command: str = "",
) -> RunResult:
    """Assemble ``result.json``."""
    initial, best = errors
    settings = job.settings
    return RunResult(
        schema_version=SCHEMA_VERSION,
        status=Status.CONVERGED if fitted.converged else Status.STOPPED,
        seed=settings.job.search.seed,
        versions=versions(),
        settings={
            "command": command,
            "vehicle": settings.vehicle.model_dump(mode="json"),
            "controller": controller_flown(job, fitted).model_dump(mode="json"),
            "job": settings.job.model_dump(mode="json"),
            "origin": dict(settings.origin),
            "noise": dict(fitted.noise),
            "scales": {name: dict(scale) for name, scale in fitted.scales.items()},
            "offsets": offsets_by_flight(job, fitted),
            "window_starts": starts_moved(fitted),
            "starts": [
                {"origin": outcome.origin, "cost": outcome.loss} for outcome in fitted.outcomes
            ],
        },
        coefficients=_coefficients(job, fitted, uncertainty),
        flights=tuple(
            _flight(job, fitted, flight, initial[flight.name].rmse, best[flight.name].rmse)
            for flight in job.flights
        ),
        findings=fitted.findings,
        search=SearchResult(
            method=fitted.method,
            evaluations=fitted.evaluations,
            iterations=len(fitted.iterations),
            wall_time=fitted.wall_time,
            cost_initial=fitted.loss_initial,
            cost_best=fitted.loss_best,
            converged=fitted.converged,
            message=Ending.NO_FURTHER_GAIN if fitted.converged else Ending.ITERATION_LIMIT,
        ),
    )


def _coefficients(
    job: Job, fitted: Fitted, uncertainty: Uncertainty
) -> dict[str, CoefficientResult]:
    start = _initial(job)
    best = best_values(job, fitted)
    raw, kept = job.space.values(fitted.point.coefficients), impossible(job, fitted)
    undetermined = {
        name: fitted.held[parameter.name]
        for parameter in job.space.parameters
        if parameter.name in fitted.held
        for name in parameter.ratios
    }
    bounds = {
        name: (parameter.lower * ratio, parameter.upper * ratio)
        for parameter in job.space.parameters
        for name, ratio in parameter.ratios.items()
    }
    found = {}
    for name, value in start.items():
        unit = COEFFICIENTS[name].unit
        if name not in best:
            found[name] = CoefficientResult(
                unit=unit,
                initial=value,
                best=value,
                fitted=False,
                verdict=Verdict.FIXED,
                reason=NOT_FITTED,
                note=judgement_in_words(Verdict.FIXED, NOT_FITTED),
            )
            continue
        low, high = bounds[name]
        estimate = uncertainty.estimates[name]
        if name in kept:
            verdict, reason = judge_impossible_inertia(float(raw[name]))
        elif name in undetermined:
            verdict, reason = judge_after_holding(
                name, estimate.verdict, estimate.reason, undetermined[name]
            )
        else:
            verdict, reason = estimate.verdict, estimate.reason
        found[name] = CoefficientResult(
            unit=unit,
            initial=value,
            best=best[name],
            fitted=True,
            lower=low,
            upper=high,
            std_error=_finite(estimate.std_error),
            ci95=_interval(estimate.ci95),
            identifiable=reason.identifiable,
            verdict=verdict,
            reason=reason,
            note=judgement_in_words(verdict, reason),
        )
    return found


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _interval(pair: tuple[float, float]) -> tuple[float, float] | None:
    low, high = pair
    return (low, high) if np.isfinite(low) and np.isfinite(high) else None


def _flight(
    job: Job, fitted: Fitted, flight: Flight, initial: AxesRmse, best: AxesRmse
) -> FlightResult:
    return FlightResult(
        name=flight.name,
        path=flight.path,
        sha256=flight.sha256,
        split="holdout" if flight in job.held_out else "fit",
        duration=flight.duration,
        time_offset=offsets_of(job, fitted).get(flight.name, 0.0),
        rmse_initial=initial,
        rmse_best=best,
    )


def versions() -> dict[str, str]:
    """Return the versions that decide a run's numbers."""
    found = {"python": platform.python_version()}
    for name in LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found


def write_folder(folder: Path, result: RunResult, vehicle: VehicleFile, job: Job) -> None:
    """Write ``best_fit.yaml``, ``metrics.csv`` and, last, ``result.json``."""
    fitted = ", ".join(flight.name for flight in job.fitted)
    source = {"made_by": f"multirotor-tune {result.versions['multirotor-tune']}", "flights": fitted}
    named = vehicle.replace(name=f"{job.settings.vehicle.name}_fitted", source=source)
    write_vehicle(named, folder / BEST_FIT_FILE, header=f"Fitted by tune to {fitted}.")
    write_text(folder / METRICS_FILE, metrics(result))
    write_result(result, folder)


def metrics(result: RunResult) -> str:
    """Return ``metrics.csv``: one row a flight and axis."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["flight", "split", "axis", "unit", "rmse_initial", "rmse_best"])
    for flight in result.flights:
        for axis, unit in UNITS.items():
            pair = (getattr(flight.rmse_initial, axis), getattr(flight.rmse_best, axis))
            table.writerow(
                [
                    flight.name,
                    flight.split,
                    axis,
                    unit,
                    *("" if v is None else repr(v) for v in pair),
                ]
            )
    return text.getvalue()

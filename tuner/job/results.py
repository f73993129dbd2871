"""The files of a result folder, assembled from a finished search and its examination."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import JsonValue

from sim_jax.inlet import ReferenceInlet
from tuner.config import Settings
from tuner.core.disk import write_text
from tuner.core.files import csv_text
from tuner.core.numerics import Z95
from tuner.core.runtime import PROGRAM, versions
from tuner.core.yaml_section import commented, dump_yaml
from tuner.design.proposals import LogProposal, Proposals
from tuner.design.ranking import (
    CLEARANCE_M,
    FLIGHT_HEIGHT_M,
    MIN_RADIUS_M,
    Arena,
    rank_next_flights,
)
from tuner.evaluate.records import RMSE_UNITS
from tuner.evaluate.validation import Validation
from tuner.findings.findings import Finding
from tuner.objective.criterion import OFFSET_UNIT
from tuner.objective.initial_conditions import ROWS
from tuner.objective.inlets import INLETS, window_seconds
from tuner.objective.normal_equations import normal_equations
from tuner.objective.segments import OFFSETS
from tuner.recordings.flight import Flight
from tuner.result import (
    BEST_FIT_FILE,
    EFFECTIVE_FILE,
    CoefficientResult,
    EffectiveResult,
    Ending,
    FlightResult,
    RunResult,
    SearchResult,
    Status,
)
from tuner.search.job_flights import JobFlight
from tuner.search.problem import Job
from tuner.search.progress import (
    Fit,
    best_values,
    conditions_of,
    controller_flown,
    impossible_inertia,
    offsets_of,
    vehicle_fitted,
)
from tuner.terms.candidates import SelectionResult
from tuner.uncertainty.estimates import Uncertainty
from tuner.uncertainty.examination import Examination
from tuner.uncertainty.records import Sources
from tuner.uncertainty.verdict import (
    NOT_EXAMINED,
    NOT_FITTED,
    Reason,
    ReasonCode,
    Verdict,
    judge_after_holding,
    judge_by_error,
)
from tuner.vehicle import COEFFICIENTS, ControllerFile, VehicleFile, initial_values, write_vehicle
from tuner.vehicle.vehicle import scaled_to_size

METRICS_FILE = "metrics.csv"
CONTROLLER_FILE = "controller.yaml"


def run_result(
    selected: SelectionResult,
    validation: Validation,
    uncertainty: Uncertainty | None,
    *,
    findings: tuple[Finding, ...],
    command: str,
    sources: Mapping[str, Sources] | None = None,
    effective: EffectiveResult | None = None,
    next_log: tuple[LogProposal, ...] = (),
) -> RunResult:
    """Assemble ``result.json``.

    ``uncertainty`` is None where it was not examined, or not yet.
    """
    job, fitted, settings = selected.job, selected.fitted, selected.job.settings
    # of each clock in s, and of each gyro axis in rad/s
    table = np.asarray(fitted.point.offsets)[: len(OFFSETS)] * OFFSET_UNIT
    return RunResult(
        status=Status.CONVERGED if fitted.converged else Status.STOPPED,
        seed=settings.job.search.seed,
        versions=versions(),
        settings={
            "command": command,
            **settings_record(settings, controller_flown(job, fitted), fitted),
            "offsets": {
                flight.name: dict(zip(OFFSETS, offsets.tolist(), strict=True))
                for flight, offsets in zip(job.fitted, table.T, strict=True)
            },
            "window_starts": shifts_of_starts(fitted),
            "starts": [
                {"origin": outcome.origin, "cost": outcome.loss} for outcome in fitted.outcomes
            ],
        },
        coefficients=_coefficients(job, fitted, uncertainty),
        sources=dict(sources or {}),
        flights=tuple(_flight(job, fitted, recording, validation) for recording in job.recordings),
        findings=findings,
        search=SearchResult(
            method=fitted.method,
            evaluations=fitted.evaluations,
            iterations=len(fitted.iterations),
            wall_time=fitted.wall_time,
            cost_initial=_loss_at_start(job, fitted),
            cost_best=fitted.loss_best,
            converged=fitted.converged,
            message=Ending.NO_FURTHER_GAIN if fitted.converged else Ending.ITERATION_LIMIT,
        ),
        selection=selected.rows_after_holding,
        effective=effective,
        next_log=next_log,
    )


def settings_record(
    settings: Settings, controller: ControllerFile, fitted: Fit
) -> dict[str, JsonValue]:
    """Return the files of a fit, their origin, and the weights of its residuals, for JSON."""
    return {
        "vehicle": settings.vehicle.model_dump(mode="json"),
        "controller": controller.model_dump(mode="json"),
        "job": settings.job.model_dump(mode="json"),
        "origin": dict(settings.origin),
        "noise": dict(fitted.noise),
        "scales": {name: dict(scale) for name, scale in fitted.scales.items()},
    }


def _loss_at_start(job: Job, fitted: Fit) -> float:
    """Return the loss with the initial coefficients, as the fit's last stage counts it."""
    objective, criterion = fitted.objective, fitted.criterion
    start = objective.start(job.space.initial)
    sums = objective.sums(start, criterion, derivatives=False)
    loss, _, _ = normal_equations(objective, start, criterion, sums)
    return float(loss)


def shifts_of_starts(fitted: Fit) -> dict[str, JsonValue]:
    """Return the root mean square shifts of free initial states.

    State -> shift in its unit: the part of the data explained by initial states, not coefficients.
    """
    start_sd, states = fitted.objective.segments.start_sd, fitted.criterion.states
    if start_sd is None or states is None:
        return {}
    moved = np.zeros((ROWS["trim"].stop, start_sd.shape[-1]))
    moved[list(fitted.objective.segments.free_rows)] = np.asarray(states) * start_sd
    return {name: float(np.sqrt(np.mean(moved[rows] ** 2))) for name, rows in ROWS.items()}


def _coefficients(
    job: Job, fitted: Fit, uncertainty: Uncertainty | None
) -> dict[str, CoefficientResult]:
    best, judgements = best_values(job, fitted), _judgements(job, fitted, uncertainty)
    bounds = {
        name: (parameter.lower * ratio, parameter.upper * ratio)
        for parameter in job.space.parameters
        for name, ratio in parameter.ratios.items()
    }
    coefficients = {}
    began = initial_values(job.user_settings.vehicle, job.user_settings.controller, job.space.free)
    errors = {} if job.accelerations is None else job.accelerations.errors
    for name, value in job.initial.items():
        initial, regressed = began.get(name, value), None
        if name in errors:
            bounded = scaled_to_size(COEFFICIENTS[name], job.space.size).limits(initial)
            regressed = _regressed(name, initial, best.get(name, value), errors[name], bounded)
        if name not in best:
            coefficients[name] = regressed or CoefficientResult.judged(
                name, value, value, Verdict.FIXED, NOT_FITTED
            )
            continue
        estimate = None if uncertainty is None else uncertainty.estimates[name]
        if (
            regressed is not None
            and estimate is not None
            and (regressed.std_error or 0.0) > estimate.std_error
        ):
            coefficients[name] = regressed
            continue
        (lower, upper), (verdict, reason) = bounds[name], judgements[name]
        more: dict[str, Any] = {"fitted": True, "lower": lower, "upper": upper}
        if estimate is not None:
            more |= {
                "std_error": estimate.std_error,
                "std_error_parts": estimate.parts,
                "ci95": estimate.ci95 if np.isfinite(estimate.ci95).all() else None,
                "identifiable": reason.identifiable,
            }
        coefficients[name] = CoefficientResult.judged(
            name, initial, best[name], verdict, reason, **more
        )
    return coefficients


def _judgements(
    job: Job, fitted: Fit, uncertainty: Uncertainty | None
) -> dict[str, tuple[Verdict, Reason]]:
    values = job.space.numbers(fitted.point.coefficients)
    judgements = dict.fromkeys(values, (Verdict.NOT_EXAMINED, NOT_EXAMINED))
    if uncertainty is not None:
        judgements = {
            name: (estimate.verdict, estimate.reason)
            for name, estimate in uncertainty.estimates.items()
        }
    for parameter in job.space.parameters:
        if parameter.name in fitted.held:
            for name in parameter.ratios:
                judgements[name] = judge_after_holding(
                    name, *judgements[name], fitted.held[parameter.name]
                )
    for name in impossible_inertia(job, fitted):
        reason = Reason(code=ReasonCode.IMPOSSIBLE_INERTIA, fitted_value=values[name])
        judgements[name] = Verdict.HELD, reason
    return judgements


def _regressed(
    name: str, initial: float, best: float, error: float, bounds: tuple[float, float]
) -> CoefficientResult:
    """Return a coefficient by regression of accelerations, its error that of the scaled number."""
    if COEFFICIENTS[name].scale == "log":
        std_error, relative, unit = best * error, error, None
        low, high = (best * float(np.exp(side * Z95 * error)) for side in (-1, 1))
    else:
        std_error, relative, unit = error, error / max(abs(best), 1e-300), COEFFICIENTS[name].unit
        low, high = (best + side * Z95 * error for side in (-1, 1))
    verdict, reason = judge_by_error(
        error, relative, unit, known=ReasonCode.REGRESSED, roughly=ReasonCode.WIDE_INTERVAL
    )
    return CoefficientResult.judged(
        name,
        initial,
        best,
        verdict,
        reason,
        std_error=std_error,
        ci95=(max(low, min(bounds[0], best)), min(high, max(bounds[1], best))),
        identifiable=reason.identifiable,
    )


def _flight(job: Job, fitted: Fit, recording: JobFlight, validation: Validation) -> FlightResult:
    flight, name = recording.flight, recording.flight.name
    met = validation.fitted_starts.get(name)
    horizon = None
    if not INLETS[recording.inlet].closed_loop:
        horizon = window_seconds([recording.inlet], job.settings.job.search.window)
    return FlightResult(
        name=flight.name,
        path=flight.path,
        sha256=flight.sha256,
        split="holdout" if recording.holdout else "fit",
        duration=flight.duration,
        time_offset=offsets_of(job, fitted).get(flight.name, 0.0),
        conditions=conditions_of(job, fitted)[flight.name],
        rmse_initial=validation.initial[name].rmse,
        rmse_best=validation.best[name].rmse,
        clock=_clock(job, fitted, recording),
        input_late=recording.input_late,
        horizon=horizon,
        rmse_fitted_starts=None if met is None else met.rmse,
        **{
            f"predicted_{kind}": errors
            for kind, errors in validation.predicted.get(name, {}).items()
        },
    )


def _clock(job: Job, fitted: Fit, recording: JobFlight) -> Literal["given", "fitted", "assumed"]:
    """Return where a flight's clock offset comes from."""
    if recording.time_offset is not None:
        return "given"
    moved = offsets_of(job, fitted).get(recording.flight.name, 0.0) != 0.0
    return "fitted" if moved and not recording.holdout else "assumed"


def write_folder(
    folder: Path,
    result: RunResult,
    selected: SelectionResult,
    effective: VehicleFile | None = None,
) -> None:
    """Write the vehicles, ``controller.yaml``, ``metrics.csv``, and last ``result.json``.

    ``best_fit.yaml`` is the fitted vehicle; ``effective.yaml`` the one for Gazebo, where that is
    another.
    """
    settings, job = result.settings, selected.job
    fitted = ", ".join(flight.name for flight in job.fitted)
    source = {"made_by": f"{PROGRAM} {result.versions[PROGRAM]}", "flights": fitted}
    named = vehicle_fitted(job, selected.fitted).replace(
        name=f"{job.settings.vehicle.name}_fitted", source=source
    )
    write_vehicle(named, folder / BEST_FIT_FILE, header=f"Fitted by tune to {fitted}.")
    if effective is not None and result.effective is not None:
        lost = ", ".join(term.group for term in result.effective.lost)
        write_vehicle(
            effective.replace(name=f"{named.name}_in_gazebo", source=source),
            folder / EFFECTIVE_FILE,
            header=f"Effective in Gazebo, which lacks {lost}; fitted by tune to {fitted}.",
        )
    flown = commented("The controller as the fit flew it.") + dump_yaml(settings["controller"])
    write_text(folder / CONTROLLER_FILE, flown)
    write_text(folder / METRICS_FILE, metrics(result))
    result.write(folder)


def metrics(result: RunResult) -> str:
    """Return ``metrics.csv``: one row for each axis of a flight."""
    return csv_text(
        ("flight", "split", "axis", "unit", "rmse_initial", "rmse_best"),
        (
            (
                flight.name,
                flight.split,
                axis,
                unit,
                getattr(flight.rmse_initial, axis),
                getattr(flight.rmse_best, axis),
            )
            for flight in result.flights
            for axis, unit in RMSE_UNITS.items()
        ),
    )


MARGIN = 1.0
"""Length added to the extent of the recorded flights for an arena; m."""
SHORTEST = 20.0
"""Length of a proposed flight, or twice, four times as long, whichever is nearest to the recorded
ones; s. The publisher takes ten to wind up."""


def write_next_flight(
    folder: Path, job: Job, examination: Examination, fitted: Fit, arena: Arena | None = None
) -> Proposals | None:
    """Write the proposals of next flights into a result folder, and return them.

    Returns None, and writes nothing, where the controllers that flew are not simulated.

    Parameters
    ----------
    job, examination, fitted
        The recorded flights, their examination, and the fit.
    arena
        Space of the next flight; None takes that of the recorded flights, and some more.
    """
    if not isinstance(examination.full_problem.objective.segments.inlet, ReferenceInlet):
        return None
    seconds = float(np.median([flight.duration for flight in job.fitted]))
    doublings = max(round(float(np.log2(seconds / SHORTEST))), 0)
    proposals = rank_next_flights(
        examination,
        fitted.criterion,
        arena=arena_of(job.flights) if arena is None else arena,
        seconds=round(SHORTEST * 2**doublings),
    )
    proposals.write(folder)
    return proposals


def arena_of(flights: Sequence[Flight]) -> Arena:
    """Return the box about the origin that some flights took, and a little more."""
    places = np.concatenate([flight.series["position"].values for flight in flights])
    x, y = (2.0 * float(np.nanmax(np.abs(places[:, axis]))) for axis in (0, 1))
    top = float(np.nanmax(places[:, 2]))
    least = 2.0 * CLEARANCE_M + 2.0 * MIN_RADIUS_M
    return Arena(
        x=round(max(x + MARGIN, least), 1),
        y=round(max(y + MARGIN, least), 1),
        z=round(max(top + MARGIN, FLIGHT_HEIGHT_M + CLEARANCE_M), 1),
    )

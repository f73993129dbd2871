"""The command `tune sensitivity` as a function: effects and uncertainty of coefficients."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tuner.config import resolve_settings
from tuner.core.disk import exists, result_folder
from tuner.core.errors import InputError, did_you_mean
from tuner.core.runtime import versions
from tuner.design.proposals import Proposals
from tuner.design.ranking import Arena
from tuner.evaluate.validation import comparison_of
from tuner.findings.findings import Code, Finding
from tuner.job.results import settings_record, write_next_flight
from tuner.objective.normal_equations import Objective, misfit, root_mean_squares, sums_at
from tuner.options import ExaminationOptions
from tuner.report import render
from tuner.report.contents import About, ExaminedFlight, write_traces
from tuner.result import RunResult, forget, place_for
from tuner.search.continuation import SWITCH_GAIN
from tuner.search.findings import UNMATCHED_RATIO, loop_findings
from tuner.search.job_flights import read_recordings, with_logged_parameters
from tuner.search.problem import Job, job_of
from tuner.search.progress import (
    Fit,
    by_flight,
    initial_progress,
    loop_of,
    plain_criterion,
    with_loop,
)
from tuner.uncertainty.estimates import Uncertainty
from tuner.uncertainty.examination import Examination, examine, knowledge_of
from tuner.uncertainty.identifiability import profile_likelihood
from tuner.uncertainty.model_error import alternatives_of
from tuner.uncertainty.records import Knowledge, Profiles
from tuner.uncertainty.sensitivity import global_sensitivity
from tuner.vehicle import check_names


def unfitted(job: Job) -> Fit:
    """Return a job's start values as a fit, with the better of the loop's choices."""
    configured = loop_of(job.objective)
    loops = [configured, *map(configured.switched, job.undecided(job.objective))]
    tried = [_simulated(job, with_loop(job.objective, loop)) for loop in loops]
    best = min(tried, key=lambda fitted: fitted.loss_best)
    if tried[0].loss_best <= SWITCH_GAIN * best.loss_best:
        best = tried[0]
    findings = (
        *loop_findings(job, loop_of(best.objective), "info"),
        *(
            Code.POORLY_MET.warning(name, channel, noise_multiple=multiple)
            for name, of_channels in best.scales.items()
            for channel, multiple in [max(of_channels.items(), key=lambda item: item[1])]
            if multiple > UNMATCHED_RATIO
        ),
    )
    return replace(best, evaluations=len(tried), findings=findings)


def _simulated(job: Job, objective: Objective) -> Fit:
    """Return a problem at the job's vehicle as a fit, with noise scaled up to its residuals."""
    start = job.initial
    vector = job.space.vector_of(start)
    points = initial_progress(objective, vector[None]).points
    unscaled = plain_criterion(objective, objective.samples)
    sums = sums_at(objective, points, unscaled, derivatives=False)
    residual = root_mean_squares(objective, sums)
    scale = misfit({name: of_starts[0] for name, of_starts in residual.items()})
    return Fit(
        objective=objective,
        point=objective.start(vector),
        criterion=plain_criterion(objective, objective.samples, scale),
        noise=job.noise,
        scales=by_flight(scale, job.fitted),
        iterations=(),
        outcomes=(),
        method="none",
        evaluations=1,
        wall_time=0.0,
        loss_best=float(np.sum(np.asarray(sums.loss))),
        converged=True,
    )


@dataclass(frozen=True)
class SensitivityResult:
    """A folder that `examine_vehicle` wrote, and its content."""

    folder: Path
    knowledge: Knowledge
    proposals: Proposals | None
    findings: tuple[Finding, ...]


def examine_vehicle(
    options: ExaminationOptions,
    arena: Sequence[float] | None = None,
    *,
    command: str = "",
    on_message: Callable[[str], None] = lambda _: None,
) -> SensitivityResult:
    """Examine the coefficients of a vehicle on recordings, nothing fitted.

    Parameters
    ----------
    options
        Flights, vehicle, settings of the simulation, and further computations; held-out flights are
        examined like the others.
    arena
        m along x, y and up; None takes that of the recorded flights, and some more.

    Raises
    ------
    InputError
        The input cannot be used; nothing was written.
    """
    settings, logged = with_logged_parameters(resolve_settings(options, fits=False))
    room = None if arena is None else Arena.of(arena)
    check_names(options.profile or (), "--profile")
    if exists(place_for(options.out) / RunResult.FILE):
        raise InputError("--out", f"{options.out} holds the result of a fit", "name another folder")
    recordings, noticed = read_recordings(settings, holdout=())
    job = job_of(settings, recordings)
    with result_folder(options.out) as out:
        fitted = unfitted(job)
        fitted = replace(fitted, findings=(*logged, *noticed, *fitted.findings))
        on_message("simulating, and differentiating by every coefficient")
        examination = examine(
            fitted, alternatives=alternatives_of(fitted.objective, fitted.point), at_minimum=False
        )
        forget(out)
        about = About(
            command=command,
            vehicle=settings.vehicle.name,
            versions=versions(),
            settings=settings_record(settings, settings.controller, fitted),
            findings=list(fitted.findings),
            flights=[
                ExaminedFlight(name=f.name, path=str(f.path), sha256=f.sha256, duration=f.duration)
                for f in job.flights
            ],
        )
        about.write(out)
        knowledge = knowledge_of(examination, job.space, fitted.point)
        knowledge.write(out)
        on_message("simulating what could be flown next")
        proposals = write_next_flight(out, job, examination, fitted, room)
        _write_requested(options, job, fitted, examination, folder=out, on_message=on_message)
        simulated = comparison_of(job, fitted).fly(settings.vehicle, forces=True)
        write_traces(out, {"simulated": simulated})
        render(out)
    return SensitivityResult(out, knowledge, proposals, fitted.findings)


def _write_requested(
    options: ExaminationOptions,
    job: Job,
    fitted: Fit,
    examination: Examination,
    *,
    folder: Path,
    on_message: Callable[[str], None],
) -> None:
    if options.global_ is not None:
        on_message(
            f"flying vehicles between the bounds for {options.global_.capitalize()}'s indices"
        )
        indices = global_sensitivity(
            fitted.objective,
            fitted.point,
            fitted.criterion,
            method=options.global_,
            flights=[flight.name for flight in job.fitted],
            bounds=_ranges(job, examination, options.span / 100.0),
            samples=options.samples,
            seed=job.settings.job.search.seed,
        )
        indices.write(folder)
    profiles = []
    for name in options.profile or ():
        on_message(f"fitting the others again for each value of {name}")
        uncertainty = _uncertainty_with(examination, name)
        profiles.append(
            profile_likelihood(examination.full_problem, uncertainty, fitted.criterion, name)
        )
    if profiles:
        Profiles(profiles=profiles).write(folder)


def _uncertainty_with(examination: Examination, name: str) -> Uncertainty:
    """Return the uncertainty of the fitted coefficients and a named one."""
    if name in examination.uncertainty.names:
        return examination.uncertainty
    if name in examination.of_fixed:
        return examination.of_fixed[name]
    names = tuple(examination.sensitivity.steps)
    raise InputError("--profile", f"no coefficient '{name}'", did_you_mean(name, names))


def _ranges(job: Job, examination: Examination, span: float) -> dict[str, tuple[float, float]]:
    """Return the range of each fitted coefficient: the job file's bounds, else ± ``span``.

    The search's own bounds are guards: most vehicles between them cannot fly.
    """
    steps = examination.sensitivity.steps
    ranges = {}
    for parameter in job.space.parameters:
        value = examination.uncertainty.estimates[parameter.name].value
        if parameter.scale == "log":
            low, high = value / (1.0 + span), value * (1.0 + span)
        else:
            low, high = (value + side * span * steps[parameter.name] for side in (-1, 1))
        settings = job.settings.job.coefficients.get(parameter.name)
        lower, upper = (None, None) if settings is None else (settings.lower, settings.upper)
        ranges[parameter.name] = (
            max(low, parameter.lower) if lower is None else lower,
            min(high, parameter.upper) if upper is None else upper,
        )
    return ranges

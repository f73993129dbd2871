"""The command `tune` as a function: settle, prepare, check, search, validate, write, report.

Callers set jax up first, see `tuner.runtime.configure`.
"""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from math import nan
from pathlib import Path

from tuner.comparison.compare import table_of
from tuner.config import Options, Settings, VehicleFile, settle, with_values, write_vehicle
from tuner.disk import make_folder
from tuner.errors import ConfigError, EngineError, InputError, OutputError
from tuner.examination.examination import Examination
from tuner.exporters.export import exports_of_job
from tuner.exporters.refly import refly
from tuner.findings import Finding
from tuner.job.ahead import ProgramsAhead
from tuner.job.balanced import with_inputs_balanced
from tuner.job.best_fit import vehicle_fitted
from tuner.job.bootstrap import bootstrap, check_bootstrap
from tuner.job.check import check_information, check_recordings
from tuner.job.cross_validation import cross_validate, jackknife_errors
from tuner.job.disturbances import examined
from tuner.job.effective import effective_fit
from tuner.job.examination_files import write_knowledge, write_next_flight
from tuner.job.findings import (
    finer_than_steps,
    flights_worse,
    ground_conflicts,
    inputs_late,
    turning_unexplained,
    voltage_taken,
)
from tuner.job.first_terms import with_first_terms
from tuner.job.folder import folder_for
from tuner.job.held_out import Validation, validate
from tuner.job.listener import SILENT, Listener
from tuner.job.next_log import what_to_log
from tuner.job.prepare import Job, job_of
from tuner.job.results import result_of, with_errors_of_refits, write_folder
from tuner.job.search import OnProgress, parameters_of
from tuner.job.selected import Selected
from tuner.job.terms import search_with_terms
from tuner.prediction.input_lag import with_inputs_on_time
from tuner.recordings import read_usable
from tuner.report import render, write_search, write_traces
from tuner.report.background import BackgroundDrawing
from tuner.result import BEST_FIT_FILE, RunResult
from tuner.search.fitted import Fitted
from tuner.search.iteration import Iteration
from tuner.search.progress import Progress
from tuner.spans import span
from tuner.uncertainty.ground import sources_of
from tuner.wording.findings import one_line, remedy, sentence
from tuner.wording.phrases import clause
from tuner.wording.result import export_sentence


def run(
    options: Options,
    *,
    out: Path | None = None,
    resume: bool = False,
    force: bool = False,
    cross_validated: bool = False,
    refits: int | None = None,
    listener: Listener = SILENT,
    command: str = "",
) -> tuple[Path, RunResult]:
    """Fit, validate and report.

    Parameters
    ----------
    options
        What the user asked for.
    out
        Result folder; None makes one under ``runs/`` named by the time.
    resume
        Go on from the folder's checkpoint.
    force
        Search although the check before it failed.
    cross_validated
        Also leave each fitted flight out in turn.
    refits
        How many refits to flights drawn with replacement are made; None for none.
    listener
        Whom to report to.
    command
        What the user typed, for the record.

    Returns
    -------
    tuple
        The result folder and the content of its ``result.json``.

    Raises
    ------
    InputError
        The input cannot be used; nothing was written.
    OutputError
        The result folder cannot be written to; a search goes on from there with ``resume``.
    """
    if refits is not None:
        check_bootstrap(refits)
    settings = settle(options)
    listener.on_settings(settings)
    folder = folder_for(out, resume=resume)
    job, findings = _prepared(settings)
    _report(findings, listener, force=force)
    selected, fitted, examination = _fitted(
        job, findings, folder, listener, resume=resume, force=force
    )
    job = selected.job
    drawing = BackgroundDrawing()
    with span("balance"):
        fitted, examination, inertia = with_inputs_balanced(
            job, fitted, examination, listener.on_message, in_doubt=selected.in_doubt
        )
    uncertainty = examination.uncertainty
    sources = sources_of(fitted, uncertainty, examination.known)
    conflicts = ground_conflicts(sources)
    _report(conflicts, listener, force=True)
    vehicle = vehicle_fitted(job, fitted)
    fitted, validation = _validated(job, fitted, vehicle, inertia, listener)
    noticed = (*finer_than_steps(uncertainty), *voltage_taken(settings.vehicle, vehicle))
    fitted = replace(fitted, findings=(*fitted.findings, *noticed, *conflicts))
    with span("effective coefficients"):
        effective = effective_fit(
            job,
            fitted,
            vehicle,
            validation.best,
            on_progress=_reporting(listener),
            on_message=listener.on_message,
        )
    with span("what to log"):
        next_log = what_to_log(job, fitted, examination.known, vehicle)
    result = result_of(
        job,
        fitted,
        uncertainty,
        validation,
        sources=sources,
        command=command,
        selection=selected.rows_given(fitted.held),
        effective=None if effective is None else effective.result,
        next_log=next_log,
    )
    with span("results"):
        write_folder(folder, result, vehicle, job, None if effective is None else effective.vehicle)
        _write_flown(folder, validation, fitted)
    if cross_validated or refits is not None:
        result = _with_refits(
            (job, fitted),
            result,
            folder,
            cross_validated=cross_validated,
            refits=refits,
            listener=listener,
        )

    listener.on_message("Simulating which flight would be the most informative next.")
    with span("examination"):
        write_knowledge(folder, job, examination, fitted)
    drawing.begin(folder)
    with span("next flight"):
        write_next_flight(folder, job, examination, fitted)
    try:
        with span("exports"):  # while figures are still being drawn
            _export(folder, settings, listener)
    finally:
        with span("page"):
            render(folder, wait_for_plots=drawing.wait)
    return folder, result


def _prepared(settings: Settings) -> tuple[Job, tuple[Finding, ...]]:
    """Return the job of some settings, and what there is to say of it before it is simulated."""
    with span("reading"):
        recordings, left_out = read_usable(settings)
    with span("check"):
        recordings = with_inputs_on_time(recordings, settings.vehicle)
        job = with_first_terms(job_of(settings, recordings))
        return job, (*left_out, *inputs_late(job), *check_recordings(job))


def _fitted(
    job: Job,
    findings: tuple[Finding, ...],
    folder: Path,
    listener: Listener,
    *,
    resume: bool,
    force: bool,
) -> tuple[Selected, Fitted, Examination]:
    """Return where the search of a job ends, the fit that is reported, and how well it is known."""
    with ProgramsAhead(job) as ahead:
        with span("check"):
            at_start = tuple(check_information(job))
        _report(at_start, listener, force=force)

        make_folder(folder)
        on_progress = _keeping_best(folder, listener)
        try:
            selected = search_with_terms(
                job,
                folder,
                resume=resume,
                on_progress=on_progress,
                on_message=listener.on_message,
                on_estimates=listener.on_estimates,
                findings=(*findings, *at_start),
                before_selection=ahead.await_selection,
            )
        except (KeyboardInterrupt, OutputError, EngineError):
            listener.on_message(
                f"The best coefficients so far are in {folder}. "
                f"Continue the search with --out {folder} --resume."
            )
            raise
        if selected.job is job:
            ahead.await_examination()
        return examined(selected, on_progress, listener.on_message)


def _validated(
    job: Job,
    fitted: Fitted,
    vehicle: VehicleFile,
    inertia: Sequence[Finding],
    listener: Listener,
) -> tuple[Fitted, Validation]:
    """Return the fit with what its simulated flights say of it, and these.

    ``inertia`` is what the balance of moments has said; if nothing, the turning is looked at.
    """
    listener.on_message("Simulating each flight with the initial and the fitted coefficients.")
    with span("validation"):
        validation = validate(job, fitted, vehicle)
    worse = (
        *flights_worse(validation.initial, validation.best),
        *(inertia or turning_unexplained(job, validation.turning_explained)),
    )
    _report(worse, listener, force=True)
    return replace(fitted, findings=(*worse, *fitted.findings)), validation


def _write_flown(folder: Path, validation: Validation, fitted: Fitted) -> None:
    """Write how each flight is simulated, and how the search went."""
    simulations = {"initial": validation.initial, "best": validation.best}
    write_traces(folder, simulations)
    table_of(simulations).write(folder)
    write_search(folder, fitted)


def _export(folder: Path, settings: Settings, listener: Listener) -> None:
    """Write the exports that the job asks for."""
    today = datetime.date.today()
    for kind, outcome in exports_of_job(folder, settings.job.export, refly=refly, today=today):
        listener.on_message(export_sentence(kind, outcome))


def _with_refits(
    fit: tuple[Job, Fitted],
    result: RunResult,
    folder: Path,
    *,
    cross_validated: bool,
    refits: int | None,
    listener: Listener,
) -> RunResult:
    """Return the result with the standard errors of refits to other flights, and write it again."""

    def on_iteration(now: Iteration) -> None:
        listener.on_iteration(now, nan)

    jackknife: dict[str, float] = {}
    bootstrapped: dict[str, float] = {}
    if cross_validated:
        with span("cross-validation"):
            folds = cross_validate(*fit, folder, on_iteration)
        listener.on_folds(folds)
        jackknife = jackknife_errors(folds)
    if refits is not None:
        with span("bootstrap"):
            bootstrapped = bootstrap(*fit, refits, folder, on_iteration)
    result = with_errors_of_refits(result, jackknife, bootstrapped)
    result.write(folder)
    return result


def _report(findings: Sequence[Finding], listener: Listener, *, force: bool) -> None:
    """Pass findings on to the listener; refuse to go on after a failure unless forced."""
    for finding in findings:
        listener.on_message(one_line(finding))
    failure = next((finding for finding in findings if finding.level == "failure"), None)
    if failure is not None and not force:
        what, to_do = clause(sentence(failure)), clause(remedy(failure))
        raise InputError(failure.subject, what, f"{to_do}, or use --force")


def _reporting(listener: Listener) -> OnProgress:
    """Return a callback that passes the last iteration on to the listener."""

    def on_progress(_: Job, progress: Progress) -> None:
        listener.on_iteration(progress.iterations[-1], progress.left)

    return on_progress


def _keeping_best(folder: Path, listener: Listener) -> OnProgress:
    """Return a callback that writes the best vehicle so far, and reports the last iteration."""
    report = _reporting(listener)

    def on_progress(job: Job, progress: Progress) -> None:
        with suppress(ConfigError):  # on its way a search may cross what no rigid body can have
            best = with_values(job.settings.vehicle, parameters_of(job, progress))
            write_vehicle(best, folder / BEST_FIT_FILE, header="Best so far of an unfinished run.")
        report(job, progress)

    return on_progress

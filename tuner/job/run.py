"""The command `tune` as a function: settle, prepare, check, search, validate, write, report.

Callers set jax up first, see `tuner.core.runtime.configure`.
"""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from math import nan
from pathlib import Path

from tuner.config import Options, Settings, resolve_settings
from tuner.core.disk import result_folder
from tuner.core.errors import ConfigError, EngineError, InputError, OutputError
from tuner.core.phrases import clause
from tuner.core.spans import span
from tuner.design.next_log import propose_logs
from tuner.design.proposals import LogProposal
from tuner.evaluate.comparison import table_of
from tuner.evaluate.validation import (
    Validation,
    controller_flown,
    flights_not_followed,
    flights_worse,
    predicted_worse_than_held,
    validate,
    vehicle_fitted,
)
from tuner.exporters.effective import Effective, find_effective
from tuner.exporters.export import export_formats_of_job
from tuner.exporters.simulators import GAZEBO_CLASSIC
from tuner.findings.findings import Finding, merge_alike, remedy, sentence
from tuner.job.listener import SILENT, Listener
from tuner.job.prepare import check_information, prepare
from tuner.job.results import (
    result_of,
    write_folder,
    write_knowledge,
    write_next_flight,
)
from tuner.report import render, write_search, write_traces
from tuner.report.outcome import WRONG_INPUT_CODES
from tuner.report.result_texts import export_sentence
from tuner.result import BEST_FIT_FILE, OF_A_RUN, Run, RunResult, forget, place_for
from tuner.search.estimation import OnProgress
from tuner.search.findings import (
    Explanation,
    reference_voltage_findings,
    turning_findings,
)
from tuner.search.iteration import Iteration
from tuner.search.job_flights import with_logged_parameters
from tuner.search.problem import Job
from tuner.search.progress import Fitted, Progress
from tuner.terms.candidates import Selected
from tuner.terms.refit_with_disturbances import ExaminedFit, refit_and_examine
from tuner.terms.selection import search_with_terms
from tuner.uncertainty.agreement import flights_disagree, ground_conflicts, sources_of
from tuner.uncertainty.estimates import (
    FLIGHTS_REFUTE,
    finer_than_steps,
    flights_refute,
    term_findings,
)
from tuner.uncertainty.examination import Examination
from tuner.uncertainty.model_error import model_error_findings
from tuner.uncertainty.records import Sources
from tuner.uncertainty.refits import bootstrap, cross_validate, jackknife_errors
from tuner.vehicle import VehicleFile, with_values, write_vehicle


def run(
    options: Options,
    *,
    out: Path | None = None,
    resume: bool = False,
    listener: Listener = SILENT,
    command: str = "",
) -> tuple[Path, RunResult]:
    """Fit, validate and report.

    Parameters
    ----------
    out
        Result folder; None makes one under ``runs/`` named by the time.
    resume
        Go on from the folder's checkpoint.

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
    settings, logged = with_logged_parameters(resolve_settings(options))
    listener.on_settings(settings)
    _check_place(options, settings, place_for(out, resume=resume))
    job, findings = prepare(settings)
    findings = (*logged, *findings)
    refits = {
        "--cross-validate": options.cross_validate and "leaves no flight to fit",
        "--bootstrap": options.bootstrap is not None and "draws from a single flight",
    }
    for option, what in refits.items():
        if what and len(job.fitted) < 2:
            raise InputError(option, what, "give two or more")
    explanation = Explanation(listener.on_message)
    _check(findings, explanation, listener, force=options.force)
    with span("check"):
        at_start = tuple(check_information(job))
    _check(at_start, explanation, listener, force=options.force)
    with result_folder(out) as folder:
        result = _fit(
            job,
            folder,
            options,
            settings=settings,
            findings=(*findings, *at_start),
            explanation=explanation,
            listener=listener,
            command=command,
            resume=resume,
        )
    return folder, result


def _fit(
    job: Job,
    folder: Path,
    options: Options,
    *,
    settings: Settings,
    findings: tuple[Finding, ...],
    explanation: Explanation,
    listener: Listener,
    command: str,
    resume: bool,
) -> RunResult:
    """Search, validate, and write everything into a folder; findings are of the check before."""
    searched, validation, (selected, fitted, examination) = _fitted(
        job, findings, folder, explanation, listener, command=command, resume=resume
    )
    job = selected.job
    explanation.report(fitted.findings)
    vehicle = vehicle_fitted(job, fitted)
    if job is not searched.job or fitted is not searched.fitted:
        validation = _validated(job, fitted, vehicle, listener)
    explanation.add(
        (
            *flights_worse(validation.initial, validation.best),
            *flights_not_followed(job, validation.best),
            *predicted_worse_than_held(job, validation),
            *turning_findings(job, validation.turning_explained),
            *reference_voltage_findings(settings.vehicle, vehicle),
        )
    )
    sources = _examination_findings(fitted, examination, explanation)

    def written(
        effective: Effective | None = None, next_log: tuple[LogProposal, ...] = ()
    ) -> RunResult:
        result = result_of(
            job,
            replace(fitted, findings=(*fitted.findings, *explanation.findings)),
            None if examination is None else examination.uncertainty,
            validation,
            sources=sources,
            command=command,
            selection=selected.rows_after_holding(fitted.held),
            effective=None if effective is None else effective.result,
            next_log=next_log,
        )
        with span("results"):
            write_folder(
                folder, result, vehicle, job, None if effective is None else effective.vehicle
            )
        return result

    physical = Run(folder=folder, result=written(), vehicle=vehicle)
    simulations = {"initial": validation.initial, "best": validation.best}
    write_traces(folder, simulations)
    table_of(simulations).write(folder)
    write_search(folder, fitted)
    find = partial(_effective, physical, job, fitted, listener)
    stops = selected.refuted  # no other answer, and no flight to plan
    effective = None if stops else explanation.attempt("effective coefficients", find, None)
    next_log: tuple[LogProposal, ...] = ()
    if examination is not None and not stops:
        next_log = explanation.attempt(
            "what to log", partial(propose_logs, job, fitted, examination.known, vehicle), next_log
        )
    result = written(effective, next_log)
    if options.cross_validate or options.bootstrap is not None:
        result = _with_refits((job, fitted), result, folder, options, listener)
    if examination is not None:
        of_fit = folder, job, examination, fitted
        explanation.attempt("knowledge", partial(write_knowledge, *of_fit), None)
    if examination is not None and not stops:
        listener.on_message("Simulating which flight would be the most informative next.")
        explanation.attempt("next flight", partial(write_next_flight, *of_fit), None)
    explanation.attempt("exports", partial(_export, folder, settings, listener), None)
    if explanation.findings != result.findings[len(fitted.findings) :]:
        findings = (*fitted.findings, *explanation.findings)
        result = result.model_copy(update={"findings": findings})
        result.write(folder)
    explanation.attempt("page", partial(render, folder), None)
    return result


def _fitted(
    job: Job,
    findings: tuple[Finding, ...],
    folder: Path,
    explanation: Explanation,
    listener: Listener,
    *,
    command: str,
    resume: bool,
) -> tuple[Selected, Validation, ExaminedFit]:
    """Return a job's search with its terms, its validation, and its examination.

    The search's result is written before the examination.
    """
    if not resume:
        forget(folder)
    on_progress = _reporting(listener, folder)
    try:
        searched = search_with_terms(
            job,
            folder,
            resume=resume,
            on_progress=on_progress,
            on_message=listener.on_message,
            on_estimates=listener.on_estimates,
            on_doubt=listener.on_doubt,
            findings=findings,
        )
    except (KeyboardInterrupt, OutputError, EngineError):
        listener.on_stop(
            f"The best coefficients so far are in {folder}. "
            f"Continue the search with --out {folder} --resume."
        )
        raise
    if searched.refuted:
        listener.on_doubt(FLIGHTS_REFUTE)
    vehicle = vehicle_fitted(searched.job, searched.fitted)
    validation = _validated(searched.job, searched.fitted, vehicle, listener)
    rows = searched.rows_after_holding(searched.fitted.held)
    result = result_of(
        searched.job, searched.fitted, None, validation, command=command, selection=rows
    )
    with span("results"):
        write_folder(folder, result, vehicle, searched.job)
    return (
        searched,
        validation,
        refit_and_examine(searched, on_progress, listener.on_message, explanation),
    )


def _validated(job: Job, fitted: Fitted, vehicle: VehicleFile, listener: Listener) -> Validation:
    listener.on_message("Simulating each flight with the initial and the fitted coefficients.")
    with span("validation"):
        return validate(job, fitted, vehicle)


def _examination_findings(
    fitted: Fitted, examination: Examination | None, explanation: Explanation
) -> dict[str, Sources]:
    """Keep the findings of an examination; return coefficients by flights and by ground."""
    if examination is None:
        return {}
    uncertainty, information = examination.uncertainty, examination.known
    explanation.add(
        (
            *flights_refute(uncertainty),
            *finer_than_steps(uncertainty),
            *model_error_findings(examination.model_errors, uncertainty),
            *flights_disagree(fitted, examination),
            *term_findings(fitted, uncertainty),
        )
    )
    sources: dict[str, Sources] = explanation.attempt(
        "ground measurements", partial(sources_of, fitted, uncertainty, information), {}
    )
    explanation.add(ground_conflicts(sources, fitted.objective.space.fixed.get("mass")))
    return sources


def _effective(physical: Run, job: Job, fitted: Fitted, listener: Listener) -> Effective | None:
    """Return the effective coefficients in Gazebo, None where it has every term."""
    flew = replace(job.settings, controller=controller_flown(job, fitted)), job.recordings
    return find_effective(
        physical,
        GAZEBO_CLASSIC,
        lambda _: flew,
        on_message=listener.on_message,
        on_progress=partial(_reporting(listener), job),
    )


def _export(folder: Path, settings: Settings, listener: Listener) -> None:
    """Write the exports that the job asks for."""
    today = datetime.date.today()
    for kind, outcome in export_formats_of_job(folder, settings.job.export, today=today):
        listener.on_message(export_sentence(kind, outcome))


def _with_refits(
    fit: tuple[Job, Fitted], result: RunResult, folder: Path, options: Options, listener: Listener
) -> RunResult:
    """Return the result with the standard errors of refits to other flights, and write it again."""

    def on_iteration(now: Iteration) -> None:
        listener.on_iteration(now, nan)

    jackknife: dict[str, float] = {}
    bootstrapped: dict[str, float] = {}
    if options.cross_validate:
        with span("cross-validation"):
            folds = cross_validate(*fit, folder, on_iteration)
        listener.on_folds(folds)
        jackknife = jackknife_errors(folds)
    if options.bootstrap is not None:
        with span("bootstrap"):
            bootstrapped = bootstrap(*fit, options.bootstrap, folder, on_iteration)
    coefficients = {
        name: coefficient.model_copy(
            update={
                "jackknife_error": jackknife.get(name),
                "bootstrap_error": bootstrapped.get(name),
            }
        )
        if coefficient.fitted
        else coefficient
        for name, coefficient in result.coefficients.items()
    }
    result = result.model_copy(update={"coefficients": coefficients})
    result.write(folder)
    return result


def _check_place(options: Options, settings: Settings, folder: Path) -> None:
    """Refuse a result folder with inputs of the run that it would overwrite."""
    if options.bench and folder.resolve() == Path(options.bench).resolve():
        raise InputError("--out", "is the folder of --bench", "name another folder")
    read = (options.vehicle, options.controller, settings.job.vehicle, settings.job.controller)
    for file in [Path(named) for named in read if isinstance(named, str | Path)]:
        if file.name in OF_A_RUN and file.resolve().parent == folder.resolve():
            what = f"is the folder of {file}, which would be replaced"
            raise InputError("--out", what, "name another folder")


def _check(
    findings: Sequence[Finding], explanation: Explanation, listener: Listener, *, force: bool
) -> None:
    """Report findings; refuse to go on after a failure unless forced.

    Findings that files contradict the flights go to ``on_doubt``: such a search takes long to fail.
    """
    explanation.report(findings)
    other = (one for one in findings if one.level == "warning" and one.code in WRONG_INPUT_CODES)
    for finding in merge_alike(other):
        listener.on_doubt(finding)
    failure = next((finding for finding in findings if finding.level == "failure"), None)
    if failure is not None and not force:
        what, to_do = clause(sentence(failure)), clause(remedy(failure))
        raise InputError(failure.subject, what, f"{to_do}, or use --force")


def _reporting(listener: Listener, folder: Path | None = None) -> OnProgress:
    """Return a callback that reports the last iteration, and writes the best vehicle so far."""

    def on_progress(job: Job, progress: Progress) -> None:
        if folder is not None:
            with suppress(ConfigError):  # a search may pass through impossible inertias
                values = job.space.numbers(progress.best_point.coefficients)
                best = with_values(job.settings.vehicle, values)
                header = "Best so far of an unfinished run."
                write_vehicle(best, folder / BEST_FIT_FILE, header=header)
        listener.on_iteration(progress.iterations[-1], progress.left)

    return on_progress

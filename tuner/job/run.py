"""The command `tune` as a function: settle, prepare, check, search, validate, write, report.

Callers set jax up first, see `tuner.core.runtime.configure`.
"""

from __future__ import annotations

import datetime
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from math import inf, nan
from pathlib import Path
from typing import Any

from tuner.config import Settings, resolve_settings
from tuner.core.disk import result_folder
from tuner.core.errors import ConfigError, EngineError, InputError, OutputError
from tuner.core.numerics import Array
from tuner.core.phrases import clause
from tuner.core.spans import span
from tuner.design.proposals import LogProposal
from tuner.design.ranking import propose_logs
from tuner.evaluate.comparison import table_of
from tuner.evaluate.validation import (
    Validation,
    flights_not_followed,
    flights_worse,
    predicted_worse_than_held,
    validate,
)
from tuner.exporters.effective import Effective, find_effective
from tuner.exporters.export import export_formats_of_job
from tuner.exporters.simulators import GAZEBO_CLASSIC
from tuner.findings.findings import Finding, merge_alike, remedy, sentence
from tuner.job.prepare import build_ahead, check_information, prepare
from tuner.job.results import run_result, write_folder, write_next_flight
from tuner.options import Options
from tuner.report import render, write_search, write_traces
from tuner.report.outcome import WRONG_INPUT_CODES
from tuner.report.result_texts import export_sentence
from tuner.result import BEST_FIT_FILE, CHECKPOINTS, OF_A_RUN, Run, RunResult, forget, place_for
from tuner.search.findings import reference_voltage_findings, turning_findings
from tuner.search.job_flights import with_logged_parameters
from tuner.search.listener import SILENT, Iteration, Listener, Reporter
from tuner.search.problem import Job
from tuner.search.progress import Progress, controller_flown, vehicle_fitted
from tuner.terms.candidates import SelectionResult
from tuner.terms.refit_with_disturbances import refit_and_examine
from tuner.terms.selection import search_with_terms
from tuner.uncertainty.agreement import flights_disagree, ground_conflicts, sources_of
from tuner.uncertainty.estimates import (
    FLIGHTS_REFUTE,
    finer_than_steps,
    flights_refute,
    term_findings,
    unrefuted,
)
from tuner.uncertainty.examination import Examination, knowledge_of
from tuner.uncertainty.model_error import model_error_findings
from tuner.uncertainty.records import Sources
from tuner.uncertainty.refits import bootstrap, cross_validate, jackknife_errors
from tuner.vehicle import with_values, write_vehicle


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
    reporter = Reporter(listener)
    _check(findings, reporter, force=options.force)
    with span("check"):
        build_ahead(job)
        at_start = tuple(check_information(job))
    _check(at_start, reporter, force=options.force)
    with result_folder(out) as folder:
        begun = _Run(options, settings, job, folder, reporter, command)
        try:
            result = begun.fit((*findings, *at_start), resume=resume)
        except (KeyboardInterrupt, OutputError, EngineError):
            if any(folder.glob(CHECKPOINTS)):
                listener.on_stop(
                    f"The best coefficients so far are in {folder}. "
                    f"Continue with --out {folder} --resume."
                )
            raise
    return folder, result


WRITTEN_EVERY_S = 1.0
"""Least s between two files of the best vehicle so far: a step may take a hundredth of that."""


@dataclass
class _BestSoFar:
    """The best vehicle of an unfinished run, and its file."""

    path: Path
    now: tuple[Job, Array] | None = None
    written: float = -inf

    def keep(self, job: Job, progress: Progress) -> None:
        """Keep a search's best, and write it if the file is old."""
        self.now = job, progress.best_point.coefficients
        if time.monotonic() - self.written >= WRITTEN_EVERY_S:
            self.write()

    def write(self) -> None:
        """Write what was kept, if anything."""
        if self.now is None:
            return
        job, vector = self.now
        with suppress(ConfigError):  # a search may pass through impossible inertias
            values = job.space.numbers(vector)
            best = with_values(job.settings.vehicle, values)
            write_vehicle(best, self.path, header="Best so far of an unfinished run.")
        self.written = time.monotonic()

    def rescue(self) -> None:
        """Write what was kept, if that is possible still."""
        with suppress(OutputError):
            self.write()


@dataclass(frozen=True)
class _Run:
    """A run whose input was checked, and that writes into its result folder.

    ``job`` is the one that the search begins with: terms may be added.
    """

    options: Options
    settings: Settings
    job: Job
    folder: Path
    reporter: Reporter
    command: str

    def fit(self, findings: tuple[Finding, ...], *, resume: bool) -> RunResult:
        """Search, validate, and write everything; findings are of the check before.

        The search's result is written before the examination.
        """
        reporter, folder, best = self.reporter, self.folder, _BestSoFar(self.folder / BEST_FIT_FILE)
        if not resume:
            forget(folder)
        reporter.on_progress = partial(self.on_progress, best)
        try:
            searched = search_with_terms(
                self.job, folder, resume=resume, reporter=reporter, findings=findings
            )
        except (KeyboardInterrupt, OutputError, EngineError):
            best.rescue()
            raise
        if searched.refuted:
            reporter.listener.on_doubt(FLIGHTS_REFUTE)
        validation = self.validated(searched)
        self.written(searched, validation)
        selected, examination = refit_and_examine(searched, reporter)
        job, fitted = selected.job, selected.fitted
        reporter.report(fitted.findings)
        vehicle = vehicle_fitted(job, fitted)
        if fitted is not searched.fitted:
            validation = self.validated(selected)
        reporter.add(
            (
                *flights_worse(validation.initial, validation.best),
                *flights_not_followed(job, validation.best),
                *predicted_worse_than_held(job, validation),
                *turning_findings(job, validation.turning_explained),
                *reference_voltage_findings(self.settings.vehicle, vehicle),
            )
        )
        selected, sources = self.judged(selected, examination)
        write = partial(self.written, selected, validation, examination, sources=sources)
        physical = Run(folder=folder, result=write(), vehicle=vehicle)
        simulations = {"initial": validation.initial, "best": validation.best}
        write_traces(folder, simulations)
        table_of(simulations).write(folder)
        write_search(folder, fitted)
        effective, next_log = None, tuple[LogProposal, ...]()
        if not selected.refuted:  # else no other answer, and no flight to plan
            find = partial(self.effective, physical, selected)
            effective = reporter.attempt("effective coefficients", find, None)
            if examination is not None:
                propose = partial(propose_logs, job, fitted, examination.known, vehicle)
                next_log = reporter.attempt("what to log", propose, next_log)
        result = self.with_refits(selected, write(effective=effective, next_log=next_log))
        if examination is not None:
            known = partial(knowledge_of, examination, job.space, fitted.point)
            reporter.attempt("knowledge", lambda: known().write(folder), None)
            if not selected.refuted:
                reporter.on_message("Simulating which flight would be the most informative next.")
                reporter.attempt(
                    "next flight",
                    partial(write_next_flight, folder, job, examination, fitted),
                    None,
                )
        reporter.attempt("exports", self.export, None)
        findings = (*selected.fitted.findings, *reporter.findings)
        if findings != result.findings:
            result = result.model_copy(update={"findings": findings})
            result.write(folder)
        reporter.attempt("page", partial(render, folder), None)
        return result

    def on_progress(self, best: _BestSoFar, job: Job, progress: Progress) -> None:
        """Keep the best vehicle so far, and report the last iteration."""
        best.keep(job, progress)
        self.reporter.listener.on_iteration(progress.iterations[-1], progress.left)

    def validated(self, selected: SelectionResult) -> Validation:
        """Return the errors of all flights."""
        self.reporter.on_message(
            "Simulating each flight with the initial and the fitted coefficients."
        )
        with span("validation"):
            return validate(selected.job, selected.fitted)

    def written(
        self,
        selected: SelectionResult,
        validation: Validation,
        examination: Examination | None = None,
        *,
        effective: Effective | None = None,
        **more: Any,
    ) -> RunResult:
        """Write the result into the folder, and return it; ``more`` is of `run_result`."""
        result = run_result(
            selected,
            validation,
            None if examination is None else examination.uncertainty,
            findings=(*selected.fitted.findings, *self.reporter.findings),
            command=self.command,
            effective=None if effective is None else effective.result,
            **more,
        )
        with span("results"):
            write_folder(
                self.folder, result, selected, None if effective is None else effective.vehicle
            )
        return result

    def judged(
        self, selected: SelectionResult, examination: Examination | None
    ) -> tuple[SelectionResult, dict[str, Sources]]:
        """Keep the findings of an examination; return the selection without those it refutes.

        And coefficients by flights and by ground.
        """
        if examination is None:
            return selected, {}
        fitted, uncertainty = selected.fitted, examination.uncertainty
        fitted = replace(fitted, findings=unrefuted(fitted.findings, uncertainty))
        self.reporter.add(
            (
                *flights_refute(uncertainty),
                *finer_than_steps(uncertainty),
                *model_error_findings(examination.model_errors, uncertainty),
                *flights_disagree(fitted, examination),
                *term_findings(fitted, uncertainty, selected.substitutes),
            )
        )
        find = partial(sources_of, fitted, uncertainty, examination.known)
        sources: dict[str, Sources] = self.reporter.attempt("ground measurements", find, {})
        self.reporter.add(ground_conflicts(sources, fitted.objective.space.fixed.get("mass")))
        return replace(selected, fitted=fitted), sources

    def effective(self, physical: Run, selected: SelectionResult) -> Effective | None:
        """Return the effective coefficients in Gazebo, None where it has every term."""
        job = selected.job
        flown = replace(job.settings, controller=controller_flown(job, selected.fitted))
        listener = self.reporter.listener
        return find_effective(
            physical,
            GAZEBO_CLASSIC,
            lambda _: (flown, job.recordings),
            on_message=listener.on_message,
            on_progress=lambda now: listener.on_iteration(now.iterations[-1], now.left),
        )

    def export(self) -> None:
        """Write the exports that the job asks for."""
        formats, today = self.settings.job.export, datetime.date.today()
        for kind, outcome in export_formats_of_job(self.folder, formats, today=today):
            self.reporter.on_message(export_sentence(kind, outcome))

    def with_refits(self, selected: SelectionResult, result: RunResult) -> RunResult:
        """Return the result with the standard errors of requested refits, and write it again."""
        job, fitted, listener = selected.job, selected.fitted, self.reporter.listener
        errors: dict[str, dict[str, float]] = {}

        def on_iteration(now: Iteration) -> None:
            listener.on_iteration(now, nan)

        if self.options.cross_validate:
            with span("cross-validation"):
                folds = cross_validate(job, fitted, self.folder, on_iteration)
            listener.on_folds(folds)
            errors["jackknife_error"] = jackknife_errors(folds)
        if (count := self.options.bootstrap) is not None:
            with span("bootstrap"):
                errors["bootstrap_error"] = bootstrap(job, fitted, count, self.folder, on_iteration)
        if not errors:
            return result
        coefficients = {
            name: coefficient.model_copy(
                update={kind: of_kind.get(name) for kind, of_kind in errors.items()}
            )
            if coefficient.fitted
            else coefficient
            for name, coefficient in result.coefficients.items()
        }
        result = result.model_copy(update={"coefficients": coefficients})
        result.write(self.folder)
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


def _check(findings: Sequence[Finding], reporter: Reporter, *, force: bool) -> None:
    """Report findings; refuse to go on after a failure unless forced.

    Findings that files contradict the flights go to ``on_doubt``: such a search takes long to fail.
    """
    reporter.report(findings)
    other = (one for one in findings if one.level == "warning" and one.code in WRONG_INPUT_CODES)
    for finding in merge_alike(other):
        reporter.listener.on_doubt(finding)
    failure = next((finding for finding in findings if finding.level == "failure"), None)
    if failure is not None and not force:
        what, to_do = clause(sentence(failure)), clause(remedy(failure))
        raise InputError(failure.subject, what, f"{to_do}, or use --force")

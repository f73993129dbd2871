"""The command `tune` as a function: settle, prepare, check, search, validate, write, report."""

from __future__ import annotations

import datetime
import logging
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from tuner.config import Options, Settings, settle, with_values, write_vehicle
from tuner.disk import make_folder
from tuner.errors import ConfigError, InputError
from tuner.job.folder import folder_for
from tuner.result import BEST_FIT_FILE, RunResult
from tuner.wording.findings import one_line, remedy, sentence
from tuner.wording.phrases import clause

if TYPE_CHECKING:
    from tuner.findings import Finding
    from tuner.job.cross_validation import Fold
    from tuner.job.prepare import Job
    from tuner.search.progress import Progress

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Listener:
    """What a run tells while it works.

    Attributes
    ----------
    settled
        The settings, before anything is read.
    iteration
        Stage, iteration number, horizon in s, loss, position RMSE in m, and the s that the search
        may still take (NaN where nobody knows).
    message
        One line for people.
    folds
        What leaving each flight out in turn gave.
    """

    settled: Callable[[Settings], None]
    iteration: Callable[[str, int, float, float, float, float], None]
    message: Callable[[str], None]
    folds: Callable[[Sequence[Fold]], None]


SILENT = Listener(lambda _: None, lambda *_: None, lambda _: None, lambda _: None)


def run(
    options: Options,
    *,
    out: Path | None = None,
    resume: bool = False,
    force: bool = False,
    cross_validated: bool = False,
    listener: Listener = SILENT,
    command: str = "",
) -> tuple[Path, RunResult]:
    """Fit, validate and report.

    Parameters
    ----------
    options
        What the user said.
    out
        Result folder; None makes one under ``runs/`` named by the time.
    resume
        Go on from the folder's checkpoint.
    force
        Search although the check before it failed.
    cross_validated
        Also leave each fitted flight out in turn.
    listener
        Is told how it goes.
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
    """
    from tuner.runtime import configure  # noqa: PLC0415 (jax starts here)

    configure()
    from tuner.exporters.after_run import exports_of_job  # noqa: PLC0415
    from tuner.exporters.refly import refly  # noqa: PLC0415
    from tuner.job.check import check  # noqa: PLC0415
    from tuner.job.cross_validation import cross_validate  # noqa: PLC0415
    from tuner.job.examination_files import write_knowledge, write_next_flight  # noqa: PLC0415
    from tuner.job.findings import finer_than_steps  # noqa: PLC0415
    from tuner.job.holding import with_undetermined_held  # noqa: PLC0415
    from tuner.job.prepare import prepare  # noqa: PLC0415
    from tuner.job.results import (  # noqa: PLC0415
        result_of,
        validate,
        vehicle_fitted,
        write_folder,
    )
    from tuner.job.search import search  # noqa: PLC0415
    from tuner.report import render, write_laps, write_search, write_traces  # noqa: PLC0415
    from tuner.report.background import BackgroundDrawing  # noqa: PLC0415

    settings = settle(options)
    listener.settled(settings)
    folder = folder_for(out, resume=resume)
    job = prepare(settings)
    findings = check(job)
    _report(findings, listener, force=force)
    make_folder(folder)
    keep = _keeper(folder, listener)
    try:
        fitted = search(job, folder, resume=resume, on_progress=keep, findings=findings)
    except KeyboardInterrupt:
        listener.message(f"the best so far is in {folder}; go on with --out {folder} --resume")
        raise
    background = BackgroundDrawing()
    listener.message("telling how far each coefficient can be trusted")
    fitted, examination = with_undetermined_held(job, fitted, keep, listener.message)
    uncertainty = examination.uncertainty
    fitted = replace(fitted, findings=(*fitted.findings, *finer_than_steps(uncertainty)))
    vehicle = vehicle_fitted(job, fitted)
    listener.message("flying every flight with the initial and the fitted coefficients")
    errors = validate(job, fitted, vehicle)
    result = result_of(job, fitted, uncertainty, errors, command=command)
    write_folder(folder, result, vehicle, job)
    write_traces(folder, *errors)
    write_laps(folder, *errors)
    write_search(folder, fitted)
    if cross_validated:
        listener.folds(cross_validate(job, fitted, folder, _teller(listener)))
    listener.message("simulating what could be flown next")
    write_knowledge(folder, job, examination, fitted)
    background.begin(folder)
    write_next_flight(folder, job, examination, fitted)
    render(folder, wait_for_plots=background.wait)
    for line in exports_of_job(
        folder, settings.job.export, refly=refly, today=datetime.date.today()
    ):
        listener.message(line)
    return folder, result


def _report(findings: Sequence[Finding], listener: Listener, *, force: bool) -> None:
    """Pass findings on to the listener; refuse to go on after a failure unless forced."""
    for finding in findings:
        listener.message(one_line(finding))
    failures = [finding for finding in findings if finding.level == "failure"]
    if failures and not force:
        first = failures[0]
        raise InputError(
            first.subject, clause(sentence(first)), f"{clause(remedy(first))}, or use --force"
        )


def _teller(listener: Listener) -> Callable[[Job, Progress], None]:
    """Return what tells the listener of an iteration."""

    def tell(_: Job, progress: Progress) -> None:
        last = progress.iterations[-1]
        listener.iteration(
            last.stage, last.number, last.horizon, last.loss, last.position_rmse, progress.left
        )

    return tell


def _keeper(folder: Path, listener: Listener) -> Callable[[Job, Progress], None]:
    """Return what keeps the best set so far on disk, and tells the listener."""
    from tuner.job.search import parameters_of  # noqa: PLC0415

    tell = _teller(listener)

    def keep(job: Job, progress: Progress) -> None:
        with suppress(ConfigError):  # on its way a search may cross what no rigid body can have
            best = with_values(job.settings.vehicle, parameters_of(job, progress))
            write_vehicle(best, folder / BEST_FIT_FILE, header="Best so far of an unfinished run.")
        tell(job, progress)

    return keep

"""The search of a job and the selection of its terms: one is not finished without the other."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from tuner.core.findings import Finding
from tuner.core.spans import span
from tuner.evaluate.best_fit import point_estimates
from tuner.objective.inlets import INLETS
from tuner.search.estimation import OnProgress, search
from tuner.search.fitted import Fitted
from tuner.search.point_estimate import PointEstimate
from tuner.search.problem import Job
from tuner.terms.candidates import candidate_groups, groups_around
from tuner.terms.selection import Selection
from tuner.terms.selection_state import Selected
from tuner.vehicle.selection_table import Groups


def search_with_terms(
    job: Job,
    folder: Path,
    *,
    resume: bool,
    on_progress: OnProgress,
    on_message: Callable[[str], None],
    on_estimates: Callable[[Sequence[PointEstimate]], None] = lambda _: None,
    findings: tuple[Finding, ...] = (),
) -> Selected:
    """Look for the best coefficients of a job, and for the terms that its flights call for.

    Where most flights are far off, terms are tried before the base model is polished, and before
    CMA-ES looks for another beginning. Arguments and errors are those of `search`; between the two,
    ``on_estimates`` gets where it ended, unless it has stopped because the model is far off, and
    ``before_selection`` is called.
    """

    def searched(*, resume: bool, provisional: bool) -> Selected:
        with span("search"):
            fitted = search(
                job,
                folder,
                resume=resume,
                on_progress=on_progress,
                findings=findings,
                provisional=provisional,
            )
        if fitted.polished:
            on_estimates(point_estimates(job, fitted))
        with span("selection of terms"):
            return with_terms_selected(job, fitted, on_progress, on_message)

    selected = searched(resume=resume, provisional=bool(candidates_of(job)))
    if selected.fitted.polished:
        return selected
    return searched(resume=True, provisional=False)


def with_terms_selected(
    job: Job, fitted: Fitted, on_progress: OnProgress, on_message: Callable[[str], None]
) -> Selected:
    """Return the fit with the terms that the job names, or that the flights speak for.

    A job that says exactly what is free names no others, unless its ``terms`` do.
    """
    clock = time.perf_counter()
    selected = _selected(job, fitted, on_progress, on_message)
    spent = time.perf_counter() - clock
    return replace(selected, fitted=replace(selected.fitted, wall_time=fitted.wall_time + spent))


def _selected(
    job: Job, fitted: Fitted, on_progress: OnProgress, on_message: Callable[[str], None]
) -> Selected:
    if not isinstance(job.settings.job.terms, str):
        named = Selection(job, fitted, {}, on_progress, on_message).rows_of_named()
        return Selected(job, fitted, named)
    candidates = candidates_of(job)
    if not candidates:
        rows = () if job.accelerations is None else job.accelerations.rows
        return Selected(job, fitted, rows)
    return Selection(job, fitted, candidates, on_progress, on_message).run()


def candidates_of(job: Job) -> Groups:
    """Return the groups among which a job's flights choose: none where it says what is free."""
    settings = job.settings.job
    if settings.terms != "auto" or settings.free is not None:
        return {}
    closed = all(INLETS[inlet].closed_loop for inlet in job.inlets)
    return {
        **candidate_groups(job.settings.vehicle, job.space, settings),
        **groups_around(job.objective, closed_loop=closed),
    }

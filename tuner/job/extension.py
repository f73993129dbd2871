"""A job and its fit with more coefficients free: terms come in at their neutral values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tuner.job.polish import polished
from tuner.job.prepare import Job
from tuner.job.search import OnProgress, free_offsets
from tuner.search.fitted import Fitted
from tuner.search.optimiser import Free
from tuner.selection.candidates import Groups, with_terms


def refitted_with(
    job: Job, fitted: Fitted, groups: Groups, on_progress: OnProgress
) -> tuple[Job, Fitted]:
    """Return job and fit with groups freed from their neutral values on, and all polished."""
    job, fitted = extended(job, fitted, [name for names in groups.values() for name in names])
    return job, _polished(job, fitted, f"with {', '.join(groups)}", on_progress)


def extended(job: Job, fitted: Fitted, names: Sequence[str]) -> tuple[Job, Fitted]:
    """Return job and fit with some coefficients free, at their neutral values."""
    objective, point = with_terms(fitted.objective, fitted.point, names, job.settings.job)
    added = np.asarray(point.coefficients)[len(job.space) :]
    outcomes = tuple(
        replace(
            outcome,
            vector=np.concatenate([outcome.vector, added]),
            start=np.concatenate([outcome.start, added]),
        )
        for outcome in fitted.outcomes
    )
    return (
        replace(
            job, space=objective.space, objective=replace(job.objective, space=objective.space)
        ),
        replace(fitted, objective=objective, point=point, outcomes=outcomes),
    )


def _polished(job: Job, fitted: Fitted, title: str, on_progress: OnProgress) -> Fitted:
    free = Free(np.ones(len(job.space), bool), free_offsets(job))
    return polished(
        job, fitted, free=free, title=title, on_progress=lambda progress: on_progress(job, progress)
    )

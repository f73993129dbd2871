"""A job and its fit with more coefficients free: terms come in at their neutral values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tuner.job.prepare import Job
from tuner.search.fitted import Fitted
from tuner.selection.candidates import with_terms


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

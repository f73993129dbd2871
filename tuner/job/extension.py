"""A job and its fit with more coefficients free: terms come in at their neutral values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tuner.job.prepare import Job
from tuner.objective.normal import with_conditions
from tuner.search.fitted import Fitted
from tuner.selection.candidates import with_terms


def extended(
    job: Job, fitted: Fitted, names: Sequence[str], *, around: Sequence[str] = ()
) -> tuple[Job, Fitted]:
    """Return job and fit with some coefficients free, at their neutral values.

    ``around`` is what surrounds each flight and is estimated from now on; it begins as nothing.
    """
    objective, point = with_terms(fitted.objective, fitted.point, names, job.settings.job)
    objective, point = with_conditions(objective, point, around)
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
            job,
            space=objective.space,
            objective=replace(
                job.objective, space=objective.space, conditions=objective.conditions
            ),
        ),
        replace(fitted, objective=objective, point=point, outcomes=outcomes),
    )

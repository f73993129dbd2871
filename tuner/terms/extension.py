"""A job and its fit with more coefficients free."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from tuner.core.findings import Finding
from tuner.objective.criterion import Point
from tuner.objective.normal import with_conditions
from tuner.search.findings import findings_at
from tuner.search.fitted import Fitted
from tuner.search.loop import loop_of, with_loop
from tuner.search.problem import Job
from tuner.terms.candidates import coefficients_in, conditions_in, with_terms
from tuner.terms.selection_state import offsets_of
from tuner.vehicle.selection_table import Groups


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


def with_groups(
    base: tuple[Job, Fitted],
    groups: Groups,
    fitted: Fitted,
    vector: Mapping[str, float],
    *,
    said: Collection[Finding],
) -> tuple[Job, Fitted]:
    """Return a base job with some groups in it, and its fit at the numbers of another one.

    Parameters
    ----------
    base
        Job and fit without any groups.
    groups
        What is free beside the base model.
    fitted, vector
        Where the fit with the groups is, and coefficient -> number of its search vector.
    said
        What that fit's findings say of its own coefficients.
    """
    job, grown = extended(*base, coefficients_in(groups), around=conditions_in(groups))
    there = replace(
        fitted,
        objective=with_loop(grown.objective, loop_of(fitted.objective)),
        outcomes=grown.outcomes,
        point=Point(
            jnp.asarray([vector[name] for name in job.space.names]),
            offsets_of(fitted, grown.objective),
        ),
    )
    others = [finding for finding in fitted.findings if finding not in said]
    return job, replace(there, findings=(*others, *findings_at(job, there)))

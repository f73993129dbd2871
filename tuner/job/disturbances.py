"""The coefficients once more with what pushed the flights, where something did."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from tuner.coefficients import conditions
from tuner.examination.examination import Examination, examine
from tuner.filter_error.predictor import Predictor, hidden
from tuner.filter_error.recorded import FLIGHT_CONTROLLER
from tuner.filter_error.refit import with_least_innovations
from tuner.findings import Code, Finding
from tuner.job.extension import extended
from tuner.job.holding import with_undetermined_held
from tuner.job.polish import polished
from tuner.job.prepare import Job
from tuner.job.search import free_offsets
from tuner.job.selected import Selected
from tuner.job.terms import candidates_of
from tuner.objective.alternatives import alternatives_of
from tuner.objective.criterion import Point
from tuner.search.fitted import Fitted
from tuner.search.optimiser import Free
from tuner.search.progress import Progress
from tuner.selection.doubt import in_doubt
from tuner.selection.linear import linear_of
from tuner.spans import span
from tuner.uncertainty.estimates import Uncertainty
from tuner.uncertainty.full_problem import full_problem_of

CONTRADICTS = 4.0
"""Standard errors of least squares by which no coefficient may move. Those errors are known from
some ten stretches that do not depend on each other: with ten degrees of freedom chance alone takes
one of a dozen coefficients beyond three in every sixth fit, and beyond four in every thirtieth."""


def examined(
    selected: Selected,
    on_progress: Callable[[Job, Progress], None],
    on_message: Callable[[str], None],
) -> tuple[Fitted, Examination]:
    """Return the fit with what pushed the flights, or with what they leave open held.

    And how well each coefficient is known.
    """
    with span("disturbances"):
        followed = with_disturbances(selected, on_progress, on_message)
    on_message("Examining how well each coefficient is known.")
    with span("examination"):
        return followed or with_undetermined_held(
            selected.job, selected.fitted, on_progress, on_message, in_doubt=selected.in_doubt
        )


def with_disturbances(
    selected: Selected,
    on_progress: Callable[[Job, Progress], None],
    on_message: Callable[[str], None],
) -> tuple[Fitted, Examination] | None:
    """Return the fit in which what pushed the flights is estimated too, and its examination.

    None where the job does not ask for it, where the residuals hold no more than noise, where
    set-points were not recorded, where flights are too many or too long, where a filter loses them,
    where nothing would be known better, and where the two fits contradict each other.
    """
    job, fitted = selected.job, selected.fitted
    asked = job.settings.job.disturbances
    follows = asked == "follow" or (asked == "auto" and candidates_of(job))
    if fitted.leaves_noise_alone or not fitted.polished or not follows:
        return None
    full = full_problem_of(fitted.objective, fitted.point)  # as it is examined: compiled once
    predictor = Predictor.of(full.objective, full.point, job.fitted)
    if predictor is None:
        return None
    if predictor.memory > full.objective.memory // 2:
        on_message("What pushed the flights is not followed: there are too many of them for that.")
        return None
    clock = time.perf_counter()
    names, count = full.objective.space.names, len(full.fitted)
    moves = np.isin(names, full.fitted) & ~np.isin(names, list(fitted.held.values()))
    offsets = free_offsets(job)
    enter = offsets & (np.arange(len(offsets)) != FLIGHT_CONTROLLER)[:, None]
    free = np.concatenate([moves & ~hidden(names), enter.ravel()])
    on_message("The residuals hold more than noise: fitting again with what pushed the flights.")
    problem = full.objective, full.point, fitted.criterion
    predictor, point = with_least_innovations(predictor, job.fitted, problem, free)
    if not predictor.keeps_track:
        on_message("What pushed them cannot be followed: the model lacks something else.")
        return None
    again = polished(
        job,
        replace(fitted, point=Point(point.coefficients[:count], fitted.point.offsets)),
        free=Free(np.zeros(count, bool), offsets),
        title="clocks",
        on_progress=lambda progress: on_progress(job, progress),
        stages=1,
    )
    again = replace(
        again,
        wall_time=fitted.wall_time + time.perf_counter() - clock,
        findings=(*again.findings, _finding(predictor)),
    )
    doubt, otherwise = _in_doubt(selected, again, predictor), alternatives_of(fitted.objective)
    examination = examine(again, otherwise=otherwise, predictor=predictor, in_doubt=doubt)
    before = examine(fitted, otherwise=otherwise, in_doubt=selected.in_doubt)
    if not _agree(examination.uncertainty, before.uncertainty):
        on_message("It contradicts the fit of the simulated flights, which is kept.")
        return None
    return (again, examination) if _is_sharper(examination, before) else None


def _in_doubt(selected: Selected, again: Fitted, predictor: Predictor) -> dict[str, float]:
    """Return how far coefficients would move with terms that were left out, by the innovations.

    Of what set-points hide, by least squares. A steady wind is a disturbance like others.
    """
    groups = [names for names in selected.left_out if not set(names) & set(conditions())]
    if not groups:
        return dict(selected.in_doubt)
    _, wide = extended(selected.job, again, [name for names in groups for name in names])
    space, at = wide.objective.space, wide.point.coefficients
    beside = replace(predictor, simulator=wide.objective.simulator)
    information = beside.information(wide.objective, wide.point, again.criterion)
    scaled = np.asarray(space.scaled(jnp.asarray(at)))
    linear = linear_of(information, scaled, space.prior_mean, 0.0)

    def columns(names: Collection[str]) -> NDArray[np.intp]:
        return np.flatnonzero(np.isin(space.names, list(names)))

    held = set(again.held.values())
    seen = ~hidden(again.objective.space.names)
    known = [n for n, there in zip(again.objective.space.names, seen, strict=True) if there]
    model = columns([name for name in known if name not in held])
    moves = in_doubt(linear, model, [columns(names) for names in groups])
    return {**selected.in_doubt, **{space.names[i]: float(moves[i]) for i in model}}


def _agree(new: Uncertainty, old: Uncertainty) -> bool:
    """Return whether no coefficient moved by more than the error of the fit that it moved from.

    A filter knows more where its noise model holds, and something else where it does not. Of the
    two estimates least squares' is the one that stays right then (Hausman 1978).
    """
    return all(
        abs(new.estimates[name].value - estimate.value) <= CONTRADICTS * estimate.std_error
        for name, estimate in old.estimates.items()
        if name in new.estimates
    )


def _is_sharper(new: Examination, old: Examination) -> bool:
    """Return whether coefficients are known better, in the mean of their errors' logarithms."""
    errors = [np.log(examination.uncertainty.covariance.error) for examination in (new, old)]
    return bool(np.mean(errors[0] - errors[1]) < 0.0)


def _finding(predictor: Predictor) -> Finding:
    """Return what is said of the disturbances."""
    gust, _, _, thrust, gust_seconds, thrust_seconds = np.exp(predictor.strengths).tolist()
    numbers = {
        "gust": gust,
        "gust_seconds": gust_seconds,
        "thrust": thrust,
        "thrust_seconds": thrust_seconds,
    }
    return Finding(Code.DISTURBANCES_FOLLOWED, "info", "flights", numbers)

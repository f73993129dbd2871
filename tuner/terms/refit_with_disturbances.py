"""Refit with estimated disturbances."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from tuner.core.phrases import listed
from tuner.disturbances.maximum_likelihood import STEPS, with_least_innovations
from tuner.disturbances.predictor import Predictor, hidden
from tuner.disturbances.ticks import FLIGHT_CONTROLLER
from tuner.findings.findings import Code, Finding
from tuner.objective.criterion import Point
from tuner.search.estimation import LAST, free_offsets, polished
from tuner.search.explanation import Explanation
from tuner.search.findings import odd_flights
from tuner.search.problem import Job
from tuner.search.progress import Fitted, Free, Progress
from tuner.terms.candidates import Selected, names_in
from tuner.terms.innovations import Innovations, outside
from tuner.terms.search_with_terms import (
    FILES_GAINS,
    candidates_of,
    refuted_by_commands,
    with_refuted,
)
from tuner.uncertainty.estimates import Uncertainty
from tuner.uncertainty.examination import Examination, examine, full_problem_of
from tuner.uncertainty.identifiability import with_undetermined_held
from tuner.uncertainty.model_error import Lack, alternatives_of, lack_of

CONTRADICTS = 4.0
"""Standard errors by which no coefficient may move. Those of least squares are known from some ten
stretches that do not depend on each other: with ten degrees of freedom chance alone takes one of a
dozen coefficients beyond three in every sixth fit, and beyond four in every thirtieth."""

SELECTIONS = 3
"""How often innovations may call for other terms, each time beside those of the last."""
LACKS = "Disturbances cannot be estimated: the model lacks something else."
ROUGHLY = 2
"""Steps before they do so first: what is missing would in time be taken for disturbances."""


Examined = tuple[Selected, Fitted, Examination | None]
"""A job's fit, and how well it is known; None where the examination failed."""


def examined(
    selected: Selected,
    on_progress: Callable[[Job, Progress], None],
    on_message: Callable[[str], None],
    explanation: Explanation,
) -> Examined:
    """Return the fit with estimated disturbances, or with what the flights leave open held.

    And how well each coefficient is known; first the terms, of which innovations may call for
    others. Where flights contradict the fit, or all but odd ones are matched, nothing is followed.
    """
    follow = partial(with_disturbances, on_progress=on_progress, on_message=on_message)
    followed, asked = None, selected.job.settings.job.disturbances
    if not (selected.refuted or (asked == "auto" and odd_flights(selected.fitted.scales))):
        followed = explanation.part("disturbances", partial(follow, selected), None)
    if followed is not None and (
        refuted := set(refuted_by_commands(*followed[:2])).difference(selected.kept)
    ):
        on_message(FILES_GAINS.format(listed(sorted(refuted))))
        less = with_refuted(selected, refuted)
        followed = explanation.part("disturbances", partial(follow, less), None)
    on_message("Examining how well each coefficient is known.")
    if followed is not None:
        return followed
    job, fitted = selected.job, selected.fitted
    hold = partial(
        with_undetermined_held, job, fitted, on_progress, on_message, in_doubt=selected.in_doubt
    )
    not_known: tuple[Fitted, Examination | None] = fitted, None
    return selected, *explanation.part("examination", hold, not_known)


def with_disturbances(
    selected: Selected,
    on_progress: Callable[[Job, Progress], None],
    on_message: Callable[[str], None],
) -> tuple[Selected, Fitted, Examination] | None:
    """Return the fit in which disturbances are estimated too, and its examination.

    None where the job does not ask for it, where the residuals hold no more than noise, where
    set-points were not recorded, where flights are too many or too long, where a filter loses them,
    where nothing would be known better, and where the two fits contradict each other, unless the
    simulated flights lack a lag that samples call for.
    """
    job, fitted = selected.job, selected.fitted
    asked = job.settings.job.disturbances
    follows = asked == "follow" or (asked == "auto" and candidates_of(job))
    if fitted.residuals_at_noise_level or not fitted.polished or not follows:
        return None
    full = full_problem_of(fitted.objective, fitted.point)  # as it is examined: compiled once
    terms = names_in(outside(selected))
    predictor = Predictor.of(full.objective, full.point, job.fitted, terms)
    if predictor is None:
        return None
    if predictor.memory > full.objective.memory // 2:
        on_message("Disturbances are not estimated: the flights are too long for that.")
        return None
    clock = time.perf_counter()
    on_message("The residuals hold more than noise: refitting with estimated disturbances.")
    there, predictor = _descended(selected, fitted, predictor, steps=ROUGHLY)
    if predictor.is_lost:
        on_message(LACKS)
        return None
    seen = Innovations.of(selected, there, predictor)
    had = selected.kept
    for number in range(SELECTIONS):
        chosen = seen.selection(had, first=number == 0)
        if chosen is None and number > 0:
            break
        if chosen is not None:
            on_message(_said(seen.selected, chosen))
            selected, there = chosen, chosen.fitted
        predictor = predictor.without_gains  # their memory is for the next ones
        there, predictor = _descended(selected, there, predictor)
        seen = Innovations.of(selected, there, predictor)
    simulated = seen.selected
    seen, there, predictor = _with_lags(seen, there, predictor, on_message)
    if not predictor.keeps_track:
        on_message(LACKS)
        return None
    job = seen.selected.job
    offsets = free_offsets(job)
    again = polished(
        job,
        there,
        free=Free(np.zeros(len(job.space), bool), offsets),
        title="clocks",
        on_progress=partial(on_progress, job),
        stages=LAST,
    )
    again = replace(
        again,
        wall_time=fitted.wall_time + time.perf_counter() - clock,
        findings=(*again.findings, _finding(predictor)),
    )
    otherwise = alternatives_of(again.objective, again.point, job.fitted)
    lack = _believed(lack_of(again, job.fitted), seen)
    examination = examine(
        again,
        otherwise=otherwise,
        predictor=predictor,
        in_doubt=seen.with_acting(lack, predictor).in_doubt(),
        lack=lack,
    )
    if seen.selected is not simulated:
        # without a lag that samples surely call for simulated flights tell nothing of the others
        better = True
    else:
        if set(seen.selected.kept) != set(had):
            # with other terms it is a fit of another model, which says nothing of this one
            fitted = polished(
                job,
                again,
                free=Free(np.ones(len(job.space), bool), offsets),
                title="simulated",
                on_progress=partial(on_progress, job),
            )
        otherwise = alternatives_of(fitted.objective, fitted.point)
        before = examine(fitted, otherwise=otherwise, in_doubt=selected.in_doubt, lack=lack)
        agree = _agree(examination.uncertainty, before.uncertainty)
        if not agree:
            on_message("It contradicts the fit of the simulated flights, which is kept.")
        better = agree and _is_sharper(examination.uncertainty, before.uncertainty)
    return (seen.selected, again, examination) if better else None


def _believed(lack: Lack | None, seen: Innovations) -> Lack | None:
    """Return what the model lacks, without a lateness of rotor speeds that samples contradict.

    Accelerations tell it in the few seconds in which rotors change their speed most, and there a
    gust may pass for it. Every sample of a tachometer tells it.
    """
    if lack is None or not seen.contradict("tachometer_lag", lack.late):
        return lack
    return replace(lack, late=0.0).or_none


def _with_lags(
    seen: Innovations,
    there: Fitted,
    predictor: Predictor,
    on_message: Callable[[str], None],
) -> tuple[Innovations, Fitted, Predictor]:
    """Return the fit with what acts as a latency at its neutral value, if samples call for it.

    There a fit has long made up for it, with other lags and stronger disturbances: what it is worth
    is seen once all of these have followed. Terms are judged once more beside it. A filter that has
    lost a flight calls for nothing.
    """
    with_lags = seen.with_lags() if predictor.keeps_track else None
    if with_lags is None:
        return seen, there, predictor
    without, had = predictor.without_gains, seen.selected.kept
    del predictor
    fitted, beside = _descended(with_lags, with_lags.fitted, without)
    if not (beside.keeps_track and beside.is_likelier_than(without)):
        full = full_problem_of(there.objective, there.point)
        point = Point(full.point.coefficients, without.feed.offsets)
        return seen, there, without.at(full.objective, point)
    on_message(_said(seen.selected, with_lags))
    chosen, selected = Innovations.of(with_lags, fitted, beside).selection(had), with_lags
    if chosen is not None:
        on_message(_said(selected, chosen))
        selected, fitted = chosen, chosen.fitted
    fitted, beside = _descended(selected, fitted, beside.without_gains)
    return Innovations.of(selected, fitted, beside), fitted, beside


def _descended(
    selected: Selected, fitted: Fitted, predictor: Predictor, *, steps: int = STEPS
) -> tuple[Fitted, Predictor]:
    """Return the fit to least innovations from a fit on, and what predicts there.

    The filter goes on from its own strengths and clocks.
    """
    job, own = selected.job, predictor.feed.offsets
    full = full_problem_of(fitted.objective, fitted.point)
    point = Point(full.point.coefficients, own)
    predictor = predictor.laid(full.objective, point, job.fitted)
    names, count = full.objective.space.names, len(full.fitted)
    moves = np.isin(names, full.fitted) & ~np.isin(names, list(fitted.held.values()))
    offsets = free_offsets(job)
    enter = offsets & (np.arange(len(offsets)) != FLIGHT_CONTROLLER)[:, None]
    free = np.concatenate([moves & ~hidden(names), enter.ravel()])
    problem = full.objective, point, fitted.criterion
    predictor, point = with_least_innovations(predictor, job.fitted, problem, free, steps)
    return replace(fitted, point=Point(point.coefficients[:count], fitted.point.offsets)), predictor


def _agree(new: Uncertainty, old: Uncertainty) -> bool:
    """Return whether no coefficient moved by more than the errors of both fits allow.

    A filter knows more where its noise model holds, and something else where it does not. Of the
    two estimates least squares' is the one that stays right then (Hausman 1978, who needs its
    error alone: his other estimate is never the less sure one, ours is of what set-points tell).
    """
    return all(
        abs(there.value - estimate.value)
        <= CONTRADICTS * np.hypot(estimate.std_error, there.std_error)
        for name, estimate in old.estimates.items()
        if (there := new.estimates.get(name)) is not None
    )


def _is_sharper(new: Uncertainty, old: Uncertainty) -> bool:
    """Return whether coefficients are known better, in the mean of their errors' logarithms."""
    ratios = [
        there.std_error / estimate.std_error
        for name, estimate in old.estimates.items()
        if (there := new.estimates.get(name)) is not None
    ]
    return bool(np.mean(np.log(ratios)) < 0.0)


def _said(before: Selected, after: Selected) -> str:
    """Return which terms innovations call for, and which they can do without."""
    changes = [row for row in after.rows if row not in before.rows]
    groups = [row.group for row in changes if row.kept]
    gone = [row.group for row in changes if not row.kept]
    changed = [
        f"{word} {listed(names)}" for word, names in (("with", groups), ("without", gone)) if names
    ]
    return f"Samples are predicted better so: fitting again {' and '.join(changed)}."


def _finding(predictor: Predictor) -> Finding:
    """Return what is said of the disturbances."""
    gust, _, _, thrust, gust_seconds, thrust_seconds, _ = np.exp(predictor.strengths).tolist()
    numbers = {
        "gust": gust,
        "gust_seconds": gust_seconds,
        "thrust": thrust,
        "thrust_seconds": thrust_seconds,
    }
    return Finding(Code.DISTURBANCES_FOLLOWED, "info", "flights", numbers)

"""Refit with estimated disturbances."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from tuner.core.phrases import listed
from tuner.disturbances.maximum_likelihood import MAX_STEPS, maximise_likelihood
from tuner.disturbances.predictor import Predictor, hidden_by_setpoints
from tuner.disturbances.ticks import FLIGHT_CONTROLLER
from tuner.findings.findings import Code, Finding
from tuner.objective.criterion import Point
from tuner.search.estimation import LAST_POLISH, free_offsets, polished
from tuner.search.explanation import Explanation
from tuner.search.findings import UNMATCHED_CODES, outlying_flights, unmatched_findings
from tuner.search.problem import Job
from tuner.search.progress import Fitted, Free, Progress
from tuner.terms.candidates import Selected, names_of
from tuner.terms.innovations import CONTRADICTION_SE, LinearisedInnovations, groups_left_out
from tuner.terms.search_with_terms import (
    GAINS_REFUTED,
    candidates_of,
    refuted_by_commands,
    with_refuted,
)
from tuner.uncertainty.estimates import Estimate, Uncertainty
from tuner.uncertainty.examination import Examination, examine, full_problem_of
from tuner.uncertainty.identifiability import hold_undetermined
from tuner.uncertainty.model_error import ModelErrors, alternatives_of, model_errors_of

MAX_SELECTIONS = 3
"""How often innovations may change the terms, each time after a refit."""
FILTER_LOST = "Disturbances cannot be estimated: the model lacks something else."
ROUGH_STEPS = 2
"""Steps before the first selection: more would fit missing terms by disturbances."""


ExaminedFit = tuple[Selected, Fitted, Examination | None]
"""A job's selection and fit, and its examination; None where that failed."""


def refit_and_examine(
    selected: Selected,
    on_progress: Callable[[Job, Progress], None],
    on_message: Callable[[str], None],
    explanation: Explanation,
) -> ExaminedFit:
    """Return the fit with estimated disturbances, or with undetermined coefficients held.

    Innovations may change the terms. Disturbances are not estimated where flights contradict the
    fit, nor by default where only odd flights are not matched.
    """
    refit = partial(with_disturbances, on_progress=on_progress, on_message=on_message)
    found, asked = None, selected.job.settings.job.disturbances
    if not (selected.refuted or (asked == "auto" and outlying_flights(selected.fitted.scales))):
        found = explanation.attempt("disturbances", partial(refit, selected), None)
    if found is not None and (
        refuted := set(refuted_by_commands(*found[:2])).difference(selected.kept)
    ):
        on_message(GAINS_REFUTED.format(listed(sorted(refuted))))
        less = with_refuted(selected, refuted)
        found = explanation.attempt("disturbances", partial(refit, less), None)
    on_message("Examining how well each coefficient is known.")
    if found is not None:
        return found
    job, fitted = selected.job, selected.fitted
    hold = partial(
        hold_undetermined,
        job,
        fitted,
        on_progress,
        on_message,
        selection_shifts=selected.selection_shifts,
    )
    unexamined: tuple[Fitted, Examination | None] = fitted, None
    return selected, *explanation.attempt("examination", hold, unexamined)


def with_disturbances(
    selected: Selected,
    on_progress: Callable[[Job, Progress], None],
    on_message: Callable[[str], None],
) -> tuple[Selected, Fitted, Examination] | None:
    """Return the fit in which disturbances are estimated too, and its examination.

    None where the job does not ask for it, the residuals are at the noise level, set-points were
    not recorded, flights are too many or too long, a filter loses them, or the standard errors
    would not shrink. None, too, where the two fits contradict each other, unless innovations added
    a lag that the simulated flights lack.
    """
    job, fitted = selected.job, selected.fitted
    asked = job.settings.job.disturbances
    wanted = asked == "follow" or (asked == "auto" and candidates_of(job))
    if fitted.residuals_at_noise_level or not fitted.polished or not wanted:
        return None
    full = full_problem_of(fitted.objective, fitted.point)  # the examination's: compiled once
    terms = names_of(groups_left_out(selected))
    predictor = Predictor.of(full.objective, full.point, job.fitted, terms)
    if predictor is None:
        return None
    if predictor.memory > full.objective.memory // 2:
        on_message("Disturbances are not estimated: the flights are too long for that.")
        return None
    clock = time.perf_counter()
    on_message("The residuals hold more than noise: refitting with estimated disturbances.")
    there, predictor = _fit_innovations(selected, fitted, predictor, steps=ROUGH_STEPS)
    if predictor.is_lost:
        on_message(FILTER_LOST)
        return None
    seen = LinearisedInnovations.of(selected, there, predictor)
    had = selected.kept
    for number in range(MAX_SELECTIONS):
        chosen = seen.selection(had, first=number == 0)
        if chosen is None and number > 0:
            break
        if chosen is not None:
            on_message(_changed_terms(seen.selected, chosen))
            selected, there = chosen, chosen.fitted
        predictor = predictor.without_gains  # frees their memory
        there, predictor = _fit_innovations(selected, there, predictor)
        seen = LinearisedInnovations.of(selected, there, predictor)
    simulated = seen.selected
    seen, there, predictor = _with_lag_terms(seen, there, predictor, on_message)
    if not predictor.keeps_track:
        on_message(FILTER_LOST)
        return None
    job = seen.selected.job
    offsets = free_offsets(job)
    again = polished(
        job,
        there,
        free=Free(np.zeros(len(job.space), bool), offsets),
        title="clocks",
        on_progress=partial(on_progress, job),
        stages=LAST_POLISH,
    )
    again = replace(
        again,
        wall_time=fitted.wall_time + time.perf_counter() - clock,
        findings=_findings_with_disturbances(job, again, predictor),
    )
    alternatives = alternatives_of(again.objective, again.point, job.fitted)
    model_errors = _without_contradicted_lag(model_errors_of(again, job.fitted), seen)
    examination = examine(
        again,
        alternatives=alternatives,
        predictor=predictor,
        selection_shifts=seen.with_model_error(model_errors, predictor).selection_shifts(),
        model_errors=model_errors,
    )
    if seen.selected is not simulated:
        better = True  # a fit of simulated flights that lacks a significant lag refutes nothing
    else:
        if set(seen.selected.kept) != set(had):
            # the fit with other terms is one of another model: not comparable
            fitted = polished(
                job,
                again,
                free=Free(np.ones(len(job.space), bool), offsets),
                title="simulated",
                on_progress=partial(on_progress, job),
            )
        alternatives = alternatives_of(fitted.objective, fitted.point)
        before = examine(
            fitted,
            alternatives=alternatives,
            selection_shifts=selected.selection_shifts,
            model_errors=model_errors,
        )
        agree = _estimates_agree(examination.uncertainty, before.uncertainty)
        if not agree:
            on_message("It contradicts the fit of the simulated flights, which is kept.")
        better = agree and _is_sharper(examination.uncertainty, before.uncertainty)
    return (seen.selected, again, examination) if better else None


def _without_contradicted_lag(
    model_errors: ModelErrors | None, seen: LinearisedInnovations
) -> ModelErrors | None:
    """Return the model errors without a lag of rotor speeds that innovations contradict.

    Accelerations show it only while rotors change their speed most, a few seconds in which a gust
    may imitate it. Innovations of the tachometers show it at every sample.
    """
    if model_errors is None or not seen.contradicts("tachometer_lag", model_errors.speed_lag):
        return model_errors
    return replace(model_errors, speed_lag=0.0).or_none


def _with_lag_terms(
    seen: LinearisedInnovations,
    there: Fitted,
    predictor: Predictor,
    on_message: Callable[[str], None],
) -> tuple[LinearisedInnovations, Fitted, Predictor]:
    """Return the fit with lag terms, if innovations are likelier with them.

    At its neutral value a lag acts as a latency, and the fit without it has made up for it with
    other lags and stronger disturbances. So it is judged after a refit, and the other terms are
    selected once more beside it. A filter that has lost a flight selects nothing.
    """
    with_lag_terms = seen.with_lag_terms() if predictor.keeps_track else None
    if with_lag_terms is None:
        return seen, there, predictor
    without, had = predictor.without_gains, seen.selected.kept
    del predictor
    fitted, beside = _fit_innovations(with_lag_terms, with_lag_terms.fitted, without)
    if not (beside.keeps_track and beside.is_likelier_than(without)):
        full = full_problem_of(there.objective, there.point)
        point = Point(full.point.coefficients, without.inputs.offsets)
        return seen, there, without.at(full.objective, point)
    on_message(_changed_terms(seen.selected, with_lag_terms))
    chosen, selected = (
        LinearisedInnovations.of(with_lag_terms, fitted, beside).selection(had),
        with_lag_terms,
    )
    if chosen is not None:
        on_message(_changed_terms(selected, chosen))
        selected, fitted = chosen, chosen.fitted
    fitted, beside = _fit_innovations(selected, fitted, beside.without_gains)
    return LinearisedInnovations.of(selected, fitted, beside), fitted, beside


def _fit_innovations(
    selected: Selected, fitted: Fitted, predictor: Predictor, *, steps: int = MAX_STEPS
) -> tuple[Fitted, Predictor]:
    """Return the maximum-likelihood fit to innovations, started at a fit, and its predictor.

    The filter starts from its own strengths and clocks.
    """
    job, own = selected.job, predictor.inputs.offsets
    full = full_problem_of(fitted.objective, fitted.point)
    point = Point(full.point.coefficients, own)
    predictor = predictor.laid(full.objective, point, job.fitted)
    names, count = full.objective.space.names, len(full.fitted)
    moves = np.isin(names, full.fitted) & ~np.isin(names, list(fitted.held.values()))
    offsets = free_offsets(job)
    enter = offsets & (np.arange(len(offsets)) != FLIGHT_CONTROLLER)[:, None]
    free = np.concatenate([moves & ~hidden_by_setpoints(names), enter.ravel()])
    problem = full.objective, point, fitted.criterion
    predictor, point = maximise_likelihood(predictor, job.fitted, problem, free, steps)
    return replace(fitted, point=Point(point.coefficients[:count], fitted.point.offsets)), predictor


def _estimates_agree(new: Uncertainty, old: Uncertainty) -> bool:
    """Return whether no coefficient moved by more than the errors of both fits allow.

    A filter is more efficient where its noise model holds, and inconsistent where it does not;
    least squares stays consistent (Hausman 1978, who needs its error alone, as his other estimate
    is always the more efficient one; ours is not for coefficients that set-points hide).
    """
    return all(
        abs(one.value - other.value) <= CONTRADICTION_SE * np.hypot(other.std_error, one.std_error)
        for one, other in _common_estimates(new, old)
    )


def _is_sharper(new: Uncertainty, old: Uncertainty) -> bool:
    """Return whether coefficients are known better, in the mean of their errors' logarithms."""
    ratios = [one.std_error / other.std_error for one, other in _common_estimates(new, old)]
    return bool(np.mean(np.log(ratios)) < 0.0)


def _common_estimates(new: Uncertainty, old: Uncertainty) -> list[tuple[Estimate, Estimate]]:
    both = new.estimates.keys() & old.estimates.keys()
    return [(new.estimates[name], old.estimates[name]) for name in old.estimates if name in both]


def _changed_terms(before: Selected, after: Selected) -> str:
    """Return the message that names the terms that innovations add and remove."""
    changes = [row for row in after.rows if row not in before.rows]
    groups = [row.group for row in changes if row.kept]
    gone = [row.group for row in changes if not row.kept]
    changed = [
        f"{word} {listed(names)}" for word, names in (("with", groups), ("without", gone)) if names
    ]
    return f"Samples are predicted better so: fitting again {' and '.join(changed)}."


def _findings_with_disturbances(
    job: Job, fitted: Fitted, predictor: Predictor
) -> tuple[Finding, ...]:
    """Return a fit's findings, with the strengths of the disturbances.

    Flights that are matched with their disturbances are not reported as unmatched.
    """
    flights = zip(job.fitted, predictor.matched, strict=True)
    matched = [flight.name for flight, one in flights if one]
    others = [finding for finding in fitted.findings if finding.code not in UNMATCHED_CODES]
    gust, _, _, thrust, gust_seconds, thrust_seconds, _ = np.exp(predictor.strengths).tolist()
    numbers = {
        "gust": gust,
        "gust_seconds": gust_seconds,
        "thrust": thrust,
        "thrust_seconds": thrust_seconds,
    }
    followed = Finding(Code.DISTURBANCES_FOLLOWED, "info", "flights", numbers)
    return (*others, *unmatched_findings(fitted.scales, matched), followed)

"""Refit with estimated disturbances."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from tuner.core.numerics import Array, scaled_inverse
from tuner.core.phrases import listed
from tuner.disturbances.maximum_likelihood import MAX_STEPS, maximise_likelihood
from tuner.disturbances.predictor import Predictor, hidden_by_setpoints
from tuner.disturbances.ticks import FLIGHT_CONTROLLER
from tuner.findings.findings import Code, Finding
from tuner.objective.criterion import Point
from tuner.objective.information import with_start_values
from tuner.objective.space import Space
from tuner.search.continuation import RIDGE
from tuner.search.estimation import LAST_POLISH, ROUGH_TOLERANCE, free_parameters, polished
from tuner.search.findings import UNMATCHED_CODES, outlying_flights, unmatched_findings
from tuner.search.listener import Reporter
from tuner.search.problem import Job
from tuner.search.progress import Fit
from tuner.terms.candidates import (
    SelectionResult,
    is_lumped,
    names_of,
    prior_presence_of,
    with_free,
    with_groups,
)
from tuner.terms.linearisation import (
    Columns,
    LinearisedLoss,
    linearised_from,
    neutral_of,
    vector_after,
)
from tuner.terms.model_averaging import (
    NEGLIGIBLE_SIZE,
    Evidence,
    selection_shifts,
    substitutes_of,
    values_instead,
)
from tuner.terms.score import ACCEPTED, backward_elimination, score
from tuner.terms.selection import (
    GAINS_REFUTED,
    candidates_of,
    refuted_by_commands,
    with_refuted,
)
from tuner.uncertainty.estimates import Estimate, Uncertainty
from tuner.uncertainty.examination import Examination, examine, full_problem_of
from tuner.uncertainty.identifiability import hold_undetermined
from tuner.uncertainty.model_error import ModelErrors, alternatives_of, model_errors_of
from tuner.vehicle import COEFFICIENTS, condition_rows
from tuner.vehicle.selection_table import Groups, SelectionCode, SelectionRow

MAX_SELECTIONS = 3
"""How often innovations may change the terms, each time after a refit."""
FILTER_LOST = "Disturbances cannot be estimated: the model lacks something else."
ROUGH_STEPS = 2
"""Steps before the first selection: more would fit missing terms by disturbances."""


def refit_and_examine(
    selected: SelectionResult, reporter: Reporter
) -> tuple[SelectionResult, Examination | None]:
    """Return the fit with estimated disturbances, or with undetermined coefficients held.

    And its examination; None where that failed. Innovations may change the terms. Disturbances are
    not estimated where flights contradict the fit, nor by default where only odd flights are not
    matched.
    """
    examined, setting = None, selected.job.settings.job.disturbances
    if not (selected.refuted or (setting == "auto" and outlying_flights(selected.fitted.scales))):
        refit = partial(with_disturbances, selected, reporter)
        examined = reporter.attempt("disturbances", refit, None)
    if examined is not None and (
        refuted := set(refuted_by_commands(examined[0])).difference(selected.kept)
    ):
        reporter.on_message(GAINS_REFUTED.format(listed(sorted(refuted))))
        refit = partial(with_disturbances, with_refuted(selected, refuted), reporter)
        examined = reporter.attempt("disturbances", refit, None)
    reporter.on_message("Examining how well each coefficient is known.")
    if examined is not None:
        return examined
    shifts = selected.selection_shifts
    hold = partial(
        hold_undetermined, selected.job, selected.fitted, reporter, selection_shifts=shifts
    )
    unexamined: tuple[Fit, Examination | None] = selected.fitted, None
    fitted, examination = reporter.attempt("examination", hold, unexamined)
    return replace(selected, fitted=fitted), examination


def with_disturbances(
    selected: SelectionResult, reporter: Reporter
) -> tuple[SelectionResult, Examination] | None:
    """Return the fit in which disturbances are estimated too, and its examination.

    None where the job does not ask for it, the residuals are at the noise level, set-points were
    not recorded, flights are too many or too long, a filter loses them, or the standard errors
    would not shrink. None, too, where the two fits contradict each other, unless innovations added
    a lag that the simulated flights lack.
    """
    job, fitted, on_message = selected.job, selected.fitted, reporter.on_message
    setting = job.settings.job.disturbances
    wanted = setting == "follow" or (setting == "auto" and candidates_of(job))
    if fitted.residuals_at_noise_level or not fitted.polished or not wanted:
        return None
    full = full_problem_of(fitted.objective, fitted.point)  # the examination's: compiled once
    # those that are kept, too: without one that is dropped later, all would be compiled again
    kept = [name for row in selected.rows if row.kept for name in row.names if name in COEFFICIENTS]
    terms = (*names_of(groups_left_out(selected)), *kept)
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
    again = polished(
        job,
        there,
        free=free_parameters(job, held=job.space.names),
        title="clocks",
        on_progress=partial(reporter.on_progress, job),
        stages=LAST_POLISH,
    )
    again = replace(
        again,
        wall_time=fitted.wall_time + time.perf_counter() - clock,
        findings=_findings_with_disturbances(job, again, predictor),
    )
    alternatives = alternatives_of(again.objective, again.point, job.fitted)
    model_errors = _without_contradicted_lag(model_errors_of(again, job.fitted), seen)
    doubted = seen.with_model_error(model_errors, predictor).with_doubts()
    examination = examine(
        again,
        alternatives=alternatives,
        predictor=predictor,
        selection_shifts=doubted.selection_shifts,
        model_errors=model_errors,
    )
    if seen.selected is not simulated:
        better = True  # a fit of simulated flights that lacks a significant lag refutes nothing
    else:
        if set(seen.selected.kept) != set(had):
            # the fit with other terms is one of another model: not comparable. It is compared, not
            # kept: what a rough fit leaves is less than its errors
            fitted = polished(
                job,
                again,
                free=free_parameters(job),
                title="simulated",
                on_progress=partial(reporter.on_progress, job),
                left=ROUGH_TOLERANCE,
            )
        alternatives = alternatives_of(fitted.objective, fitted.point)
        before = examine(
            fitted,
            alternatives=alternatives,
            selection_shifts=selected.selection_shifts,
            model_errors=model_errors,
            effects=False,
        )
        agree = _estimates_agree(examination.uncertainty, before.uncertainty)
        if not agree:
            on_message("It contradicts the fit of the simulated flights, which is kept.")
        better = agree and _is_sharper(examination.uncertainty, before.uncertainty)
    return (replace(doubted, fitted=again), examination) if better else None


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
    there: Fit,
    predictor: Predictor,
    on_message: Callable[[str], None],
    among: Collection[str] | None = None,
) -> tuple[LinearisedInnovations, Fit, Predictor]:
    """Return the fit with lag terms, if innovations are likelier with them and call for them.

    Of all groups of lags, or of some. The fit without a lag has made up for it with other lags and
    other disturbances. So it is judged after a refit, and the other terms are selected once more
    beside it. A filter that has lost a flight selects nothing.

    A lag shows where commands jump, often in the first tenths of a second of a flight alone. How
    far the gain scatters from stretch to stretch says nothing of it then: the scatter of the scores
    at the fit with the lag does.
    """
    with_lag_terms = seen.with_lag_terms(among) if predictor.keeps_track else None
    if with_lag_terms is None:
        return seen, there, predictor
    without, had = predictor.without_gains, seen.selected.kept
    del predictor
    fitted, beside = _fit_innovations(with_lag_terms, with_lag_terms.fitted, without)
    found = None
    if beside.keeps_track and beside.is_likelier_than(without):
        found = LinearisedInnovations.of(with_lag_terms, fitted, beside)
    lags = set(with_lag_terms.kept) - set(had)
    called = () if found is None else found.called_for(lags)
    if found is None or len(called) < len(lags):
        full = full_problem_of(there.objective, there.point)
        point = Point(full.point.coefficients, without.inputs.offsets)
        before = seen, there, without.at(full.objective, point)
        return _with_lag_terms(*before, on_message, called) if called else before
    on_message(_changed_terms(seen.selected, with_lag_terms))
    chosen, selected = found.selection(had), with_lag_terms
    if chosen is not None:
        on_message(_changed_terms(selected, chosen))
        selected, fitted = chosen, chosen.fitted
    fitted, beside = _fit_innovations(selected, fitted, beside.without_gains)
    return LinearisedInnovations.of(selected, fitted, beside), fitted, beside


def _fit_innovations(
    selected: SelectionResult, fitted: Fit, predictor: Predictor, *, steps: int = MAX_STEPS
) -> tuple[Fit, Predictor]:
    """Return the maximum-likelihood fit to innovations, started at a fit, and its predictor.

    The filter starts from its own strengths and clocks.
    """
    job, own = selected.job, predictor.inputs.offsets
    full = full_problem_of(fitted.objective, fitted.point)
    point = Point(full.point.coefficients, own)
    predictor = predictor.laid(full.objective, point, job.fitted)
    names, count = full.objective.space.names, len(full.fitted)
    moves = np.isin(names, full.fitted) & ~np.isin(names, list(fitted.held.values()))
    offsets = free_parameters(job).offsets
    enter = offsets & (np.arange(len(offsets)) != FLIGHT_CONTROLLER)[:, None]
    seen = ~hidden_by_setpoints(names, full.objective.model)
    free = np.concatenate([moves & seen, enter.ravel()])
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


def _changed_terms(before: SelectionResult, after: SelectionResult) -> str:
    """Return the message that names the terms that innovations add and remove."""
    changes = [row for row in after.rows if row not in before.rows]
    groups = [row.group for row in changes if row.kept]
    gone = [row.group for row in changes if not row.kept]
    changed = [
        f"{word} {listed(names)}" for word, names in (("with", groups), ("without", gone)) if names
    ]
    return f"Samples are predicted better so: fitting again {' and '.join(changed)}."


def _findings_with_disturbances(job: Job, fitted: Fit, predictor: Predictor) -> tuple[Finding, ...]:
    """Return a fit's findings, with the strengths of the disturbances.

    Flights that are matched with their disturbances are not reported as unmatched.
    """
    flights = zip(job.fitted, predictor.matched, strict=True)
    matched = [flight.name for flight, one in flights if one]
    others = [finding for finding in fitted.findings if finding.code not in UNMATCHED_CODES]
    gust, _, _, thrust, gust_seconds, thrust_seconds, _, wind = np.exp(predictor.strengths).tolist()
    followed = Code.DISTURBANCES_FOLLOWED.info(
        "flights",
        wind=wind,
        gust=gust,
        gust_seconds=gust_seconds,
        thrust=thrust,
        thrust_seconds=thrust_seconds,
    )
    return (*others, *unmatched_findings(fitted.scales, matched), followed)


REJECTED_BY_LEAST_SQUARES = (
    SelectionCode.NOT_SIGNIFICANT,
    SelectionCode.IMMATERIAL,
    SelectionCode.NOT_PREDICTED,
    SelectionCode.WORSE_AFTER_REFIT,
)
"""Reasons of least squares that innovations may overrule."""
NEGLIGIBLE_MOVE_SE = 2.0
"""Standard errors by which a coefficient may move where a negligible term is left out."""
MAX_CHANCE_OF_LAG = 0.05
"""Chance below which a secant lets a term be tried."""
CONTRADICTION_SE = 4.0
"""Standard errors by which two estimates contradict each other. Those of least squares are known
from some ten independent stretches: with ten degrees of freedom chance alone takes one of a dozen
coefficients beyond three in every sixth fit, and beyond four in every thirtieth."""


@dataclass(frozen=True)
class LinearisedInnovations:
    """The loss of the innovations about a fit, by its coefficients and those of omitted terms.

    Attributes
    ----------
    selected
        The terms of the fit, and those left out.
    fitted
        The fit to the innovations, in the space of ``selected``.
    space, vector
        Search space of all P coefficients, and their values.
    linear
        The loss of the innovations about ``vector``.
    """

    selected: SelectionResult
    fitted: Fit
    space: Space
    vector: Array
    linear: LinearisedLoss

    @staticmethod
    def of(
        selected: SelectionResult,
        fitted: Fit,
        predictor: Predictor,
        model_errors: ModelErrors | None = None,
    ) -> LinearisedInnovations:
        """Linearise a predictor's innovations at a fit, gains as they are.

        Model errors (``model_errors``) act in the simulation where they are known.
        """
        names = [name for group in groups_left_out(selected).values() for name in group]
        _, wide = with_free(selected.job, fitted, names)
        objective, beside = wide.objective, replace(predictor, schedule=wide.objective.schedule)
        if model_errors is not None:
            objective = model_errors.applied_to(objective)
            beside = beside.for_problem(objective)
        information = beside.information(objective, wide.point, fitted.criterion)
        space, vector = objective.space, np.asarray(wide.point.coefficients)
        scaled = space.scaled(vector)
        linear = linearised_from(
            information,
            scaled,
            space.prior_mean,
            predictor.loss,
            names=space.names,
            neutral=neutral_of(space),
        )
        return LinearisedInnovations(selected, fitted, space, vector, linear)

    def with_model_error(
        self, model_errors: ModelErrors | None, predictor: Predictor
    ) -> LinearisedInnovations:
        """Return the same with model errors acting: they hide some terms and imitate others."""
        if model_errors is None:
            return self
        return LinearisedInnovations.of(self.selected, self.fitted, predictor, model_errors)

    def with_doubts(self) -> SelectionResult:
        """Return the terms with the shifts by omitted ones, and with those that may act instead.

        The shifts of coefficients that set-points hide are those of least squares.
        """
        outside = [
            (columns, prior_presence_of(names))
            for names in groups_left_out(self.selected).values()
            if len(columns := self._columns(names))
        ]
        if not outside:
            return self.selected
        model = self._model(self.fitted.objective.space.names)
        kept = {
            row.group: columns
            for row in self.selected.rows
            if row.kept and row.reason in ACCEPTED and len(columns := self._columns(row.names))
        }
        substitutes = substitutes_of(
            self.linear, self.space, model, kept, (columns for columns, _ in outside)
        )
        moves = selection_shifts(self.linear, model, outside, substitutes)
        own = {self.space.names[i]: float(moves[i]) for i in model}
        shifts = {**self.selected.selection_shifts, **own}
        return replace(
            self.selected, selection_shifts=shifts, substitutes=values_instead(substitutes)
        )

    def contradicts(self, name: str, value: float) -> bool:
        """Return whether the innovations contradict a value of an omitted coefficient."""
        column = self._columns([name])
        if not len(column) or name in self.fitted.objective.space.names:
            return False
        model = self._model(self.fitted.objective.space.names)
        square = self.linear.information() + self.linear.prior
        evidence = Evidence.of(self.linear, square, self.linear.step(model), model, column)
        apart = evidence.value - value / self.linear.prior_sd[column]
        return bool(np.any(apart**2 > CONTRADICTION_SE**2 * evidence.variance))

    def selection(self, had: Collection[str], *, first: bool = False) -> SelectionResult | None:
        """Return the terms that innovations select and their fit, one linear step on.

        Backward elimination starts from all terms but lumped ones, and those already in the fit.
        Negligible survivors go. None if the selection stays the same, or none was tried.

        Least squares may have fitted a lumped term to gusts, and beside it the others seem
        unnecessary: it is dropped at the ``first`` selection, and may come back at later ones if
        least squares ``had`` it.
        """
        base, tried = self.selected.base, self._tried()
        within = {name: names for name, names in tried.items() if name in self.selected.kept}
        without = {name: names for name, names in within.items() if first and is_lumped(name)}
        begin = {
            name: names
            for name, names in tried.items()
            if name not in without and (name in within or name in had or not is_lumped(name))
        }
        if base is None or not (begin or without):
            return None
        judged = names_of(tried)
        model = self._model([n for n in self.fitted.objective.space.names if n not in judged])
        kept, _ = backward_elimination(
            self.linear,
            model,
            {name: self._columns(names) for name, names in begin.items()},
            candidates=len(tried),
            without=self._columns(names_of(without)),
            lumped=[name for name in begin if is_lumped(name)],
            excluding_gusts=list(begin),  # the filter estimates them
            min_gain=0.0,
            white=True,
            without_refits=True,
        )
        matter = [name for name in kept if not self._is_negligible(name, model, tried, kept)]
        if set(matter) == set(within):
            return None
        moved = vector_after(self.space, self.vector, self._change(model, tried, matter))
        return self._with(base, tried, matter, moved)

    def _is_negligible(
        self, name: str, model: Columns, tried: Groups, kept: Collection[str]
    ) -> bool:
        """Return whether a kept group is small, and others hardly move where it is left out.

        A small one that another coefficient would make up for is not: what is usual of large
        vehicles is not of small ones.
        """
        own, others = self._columns(tried[name]), [one for one in kept if one != name]
        change = self._change(model, tried, kept)
        size = np.abs(change[own] - self.linear.to_neutral(own)[own]) / self.linear.prior_sd[own]
        if size.max() > NEGLIGIBLE_SIZE:
            return False
        left = np.concatenate([model, *(self._columns(tried[other]) for other in others)])
        square = (self.linear.information() + self.linear.prior)[np.ix_(left, left)]
        moves = (self._change(model, tried, others) - change)[left]
        errors = np.sqrt(np.diag(scaled_inverse(square, RIDGE)))
        return bool(np.all(np.abs(moves) <= NEGLIGIBLE_MOVE_SE * errors))

    def called_for(self, groups: Collection[str]) -> tuple[str, ...]:
        """Return those of some groups in the fit without which innovations would be unlikely.

        Of groups that act alike, none is needed beside the others: the least needed goes first.
        """
        lags = {row.group: row.names for row in self.selected.rows if row.group in groups}
        names = self.fitted.objective.space.names
        kept, _ = backward_elimination(
            self.linear,
            self._model([name for name in names if name not in names_of(lags)]),
            {group: self._columns(own) for group, own in lags.items()},
            candidates=len(self.selected.rows),
            min_gain=0.0,
            white=True,
            without_refits=True,
        )
        return tuple(kept)

    def with_lag_terms(self, among: Collection[str] | None = None) -> SelectionResult | None:
        """Return the terms with lags added, of all or of some groups.

        No linear approximation tests them; it only shows which are worth a fit. None if none is.
        """
        base = self.selected.base
        model = self._model(self.fitted.objective.space.names)
        lags = {
            row.group: row.names
            for row in self.selected.rows
            if not row.kept
            and row.reason in REJECTED_BY_LEAST_SQUARES
            and (among is None or row.group in among)
            and any(name in COEFFICIENTS and COEFFICIENTS[name].is_lag for name in row.names)
            and score(
                self.linear,
                model,
                self._columns(row.names),
                candidates=1,
                excludes_gusts=True,
                min_gain=0.0,
            ).chance
            < MAX_CHANCE_OF_LAG
        }
        if base is None or not lags:
            return None
        return self._with(
            base, lags, lags, with_start_values(self.space, self.vector, names_of(lags))
        )

    def _with(
        self, base: tuple[Job, Fit], judged: Groups, kept: Collection[str], moved: Array
    ) -> SelectionResult:
        """Return the selection with ``kept`` of the tested groups, at a vector (P,)."""
        rows = [
            _row_after(row, kept=row.group in kept) if row.group in judged else row
            for row in self.selected.rows
        ]
        rows.sort(key=lambda row: not row.kept)
        groups = {row.group: row.names for row in rows if row.kept and row.reason in ACCEPTED}
        vector = dict(zip(self.space.names, moved.tolist(), strict=True))
        job, fitted = with_groups(base, groups, self.fitted, vector=vector)
        return replace(self.selected, job=job, fitted=fitted, rows=tuple(rows))

    def _tried(self) -> dict[str, tuple[str, ...]]:
        """Return the groups that innovations can test: those all of whose columns they see.

        A group whose derivative at its neutral value is that of another coefficient is not one.
        """
        return {
            row.group: row.names
            for row in self.selected.rows
            if row.reason in (ACCEPTED if row.kept else REJECTED_BY_LEAST_SQUARES)
            and not self._hidden(row.names).any()
            and not set(row.names) & set(condition_rows())
            and all(COEFFICIENTS[name].begin is None for name in row.names)
        }

    def _change(self, model: Columns, tried: Groups, kept: Collection[str]) -> Array:
        """Return the step (P,) to the minimum with some groups, the others at neutral values."""
        free = np.concatenate([model, *(self._columns(tried[name]) for name in kept)])
        gone = [name for group in set(tried) - set(kept) for name in tried[group]]
        removal = self.linear.to_neutral(self._columns(gone))
        return self.linear.step(free.astype(np.intp), from_=removal)

    def _model(self, names: Sequence[str]) -> Columns:
        """Return the columns of coefficients that are not held and that innovations see."""
        return self._columns([name for name in names if name not in self.fitted.held])

    def _columns(self, names: Sequence[str]) -> Columns:
        seen = ~self._hidden(self.space.names)
        return np.flatnonzero(np.isin(self.space.names, list(names)) & seen)

    def _hidden(self, names: Sequence[str]) -> NDArray[np.bool_]:
        return hidden_by_setpoints(names, self.fitted.objective.model)


def groups_left_out(selected: SelectionResult) -> Groups:
    """Return the groups left out but per-flight conditions: a filter estimates steady wind too."""
    return {names[0]: names for names in selected.left_out if not {*condition_rows()} & {*names}}


def _row_after(row: SelectionRow, *, kept: bool) -> SelectionRow:
    """Return a group's row after its test by innovations."""
    if row.kept == kept:
        return row
    reason = SelectionCode.PREDICTS_SAMPLES if kept else SelectionCode.NOT_SIGNIFICANT
    return row.model_copy(update={"kept": kept, "reason": reason})

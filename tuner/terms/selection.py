"""The search of a job with its terms: those it begins with, and those that its flights select.

One Jacobian scores all candidate groups at the fitted point. If the gain of one is significant, all
are fitted together from the search's start, and backward elimination removes those that are not
accepted beside the others. The rest stays if fits to the other flights then predict each flight
better by more than the scatter.

Per-flight conditions (wind, battery) have a column for each flight. Other flights cannot predict
them, sections of the same flight can; a held-out flight keeps its own, as it keeps its clocks.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tuner.core.numerics import Array
from tuner.core.phrases import listed
from tuner.core.spans import span
from tuner.findings.findings import Finding
from tuner.objective.battery import require_voltage
from tuner.objective.criterion import Criterion, Point, units_of
from tuner.objective.information import is_refuted, leaves_flights, with_start_values
from tuner.objective.initial_conditions import is_at_rest
from tuner.objective.inlets import INLETS
from tuner.objective.normal_equations import Objective, with_conditions
from tuner.objective.space import extended
from tuner.recordings.flight import Flight
from tuner.search.estimation import (
    ALL_BUT_LAST,
    FIRST_POLISH,
    LAST_POLISH,
    ROUGH_TOLERANCE,
    free_parameters,
    polished,
    search,
)
from tuner.search.listener import Reporter
from tuner.search.problem import Job
from tuner.search.progress import Fit, Progress, loop_of, point_estimates, with_loop
from tuner.terms.candidates import (
    SelectionResult,
    candidate_groups,
    coefficient_names,
    condition_groups,
    condition_names,
    groups_named,
    is_lumped,
    names_of,
    neutral_values,
    offsets_for,
    prior_presence_of,
    with_groups,
    with_terms,
)
from tuner.terms.linearisation import LinearisedFit, linearise, predicted_losses, vector_after
from tuner.terms.model_averaging import selection_shifts, substitutes_of, values_instead
from tuner.terms.score import Score, backward_elimination, row_of, score
from tuner.uncertainty.model_error import (
    GAIN_AXES,
    answers_of,
    gain_by_commands,
    gains_far_off,
    with_other_readings,
)
from tuner.vehicle import COEFFICIENTS, term_groups
from tuner.vehicle.model import with_coefficients
from tuner.vehicle.selection_table import Groups, SelectionCode, SelectionRow

Reasons = Mapping[str, SelectionCode]

MAX_ROUNDS = 4
"""Rounds of additions; each adds all groups with a significant gain, and prunes."""
GAINS_IN_FIT = (
    SelectionCode.PREDICTS_FLIGHTS,
    SelectionCode.PREDICTS_SECTIONS,
    SelectionCode.NOT_PREDICTED,
)


@dataclass(frozen=True)
class Selection:
    """Selection among candidate groups: rounds of additions, each followed by elimination.

    Every fit computes all terms, whichever are in its model: fits with different terms then share
    their kernels.
    """

    job: Job
    fitted: Fit
    candidates: Groups
    reporter: Reporter

    def run(self) -> SelectionResult:
        """Add groups until no other is accepted."""
        state = self.linearised(self.fitted, {})
        dropped: dict[str, SelectionCode] = {}
        if self._worth_fitting(state, dropped) and (pruned := self._with_all(state)):
            state = pruned
            gone = (name for name in self._worth_fitting(state, {}) if not is_lumped(name))
            dropped = dict.fromkeys(gone, SelectionCode.WORSE_AFTER_REFIT)
        for _ in range(MAX_ROUNDS):
            # While terms are missing, those in the model make up for them, and even a true one may
            # not seem to predict: all significant ones are fitted if one predicts. Then each has to
            wanted = self._worth_fitting(state, dropped)
            if not any(group_score.is_accepted for group_score in wanted.values()):
                break
            grown = self._with_added(state, wanted, dropped)
            if grown is None:
                continue
            if set(grown.added) <= set(state.added):
                break
            state = grown
        base, rows = (self.job, self.fitted), self._rows(state, dropped)
        selected = SelectionResult(*base, rows, base=base)
        selected = self._with_doubts(state, selected)
        if state.added:
            fitted = self._fitted(state, state.added, roughly=False)
            job, fitted = with_groups(base, state.added, fitted)
            selected = replace(selected, job=job, fitted=fitted)
        return selected

    def _with_doubts(self, state: LinearisedFit, selected: SelectionResult) -> SelectionResult:
        """Return the terms with the shifts by omitted ones, and with those that may act instead."""
        names = [*self.job.space.names, *names_of(state.added)]
        linear, model = state.linear, state.linear.columns_of(names)
        kept = {group: linear.columns_of(own) for group, own in state.added.items()}
        outside = [(linear.columns_of(own), prior_presence_of(own)) for own in selected.left_out]
        substitutes = substitutes_of(
            linear, state.fitted.objective.space, model, kept, (columns for columns, _ in outside)
        )
        moves = selection_shifts(linear, model, outside, substitutes)
        coefficients = [name for name in names if name not in condition_names(self.candidates)]
        own = linear.columns_of(coefficients)
        shifts = dict(zip(coefficients, moves[own].tolist(), strict=True))
        return replace(selected, selection_shifts=shifts, substitutes=values_instead(substitutes))

    def _worth_fitting(self, state: LinearisedFit, dropped: Reasons) -> dict[str, Score]:
        """Return the groups with a significant gain in the fit, whether they predict or not."""
        return {
            group: group_score
            for group in self.candidates
            if group not in state.added and group not in dropped
            if (group_score := self._score(state, group)).reason in GAINS_IN_FIT
        }

    def _with_all(self, base: LinearisedFit) -> LinearisedFit | None:
        """Return what backward elimination keeps of all groups, if it predicts better.

        Where terms are missing the base fit is biased, and selection from there picks the wrong
        terms, or none predicts by itself. So the search starts again with every candidate in the
        model but lumped ones: beside these nothing else would seem needed. Lumped ones are tried
        last, if something is left to explain.
        """
        groups = {group: names for group, names in self.candidates.items() if not is_lumped(group)}
        self.reporter.on_message(
            f"The flights call for more than the base model: searching again with all "
            f"{len(groups)} groups of terms, to see which can go."
        )
        trial = self._pruned(self._refitted(base, groups, anew=True))
        reasons = [self._score(trial, group).reason for group in trial.added]
        by_flight = SelectionCode.PREDICTS_FLIGHTS in reasons
        if trial.added and self._predicts_better(trial, base, by_flight=by_flight):
            return trial
        return None

    def _with_added(
        self, state: LinearisedFit, wanted: Mapping[str, Score], dropped: dict[str, SelectionCode]
    ) -> LinearisedFit | None:
        """Return the fit with the wanted groups that survive elimination, if it predicts better.

        Groups that are eliminated are not tried again.
        """
        best, judged = max(wanted, key=lambda name: wanted[name].gain_holdout), list[set[str]]()
        for names in dict.fromkeys([tuple(wanted), (best,)]):
            groups = {**state.added, **{name: self.candidates[name] for name in names}}
            if set(groups) in judged:
                break
            self.reporter.on_message(f"Fitting again with {listed(names)}.")
            trial = self._pruned(self._refitted(state, groups))
            by_flight = wanted[best].reason is SelectionCode.PREDICTS_FLIGHTS
            gone = [name for name in names if name not in trial.added]
            dropped |= dict.fromkeys(gone, SelectionCode.WORSE_AFTER_REFIT)
            judged.append(set(trial.added))
            other = judged[-1] not in (set(), set(state.added))
            if other and self._predicts_better(trial, state, by_flight=by_flight):
                return trial
        dropped[best] = SelectionCode.WORSE_AFTER_REFIT
        return None

    def _pruned(self, state: LinearisedFit) -> LinearisedFit:
        """Return the fit after backward elimination, refitted until every group is accepted."""
        kept, taken = backward_elimination(
            state.linear,
            state.linear.columns_of(self.job.space.names),
            {group: state.linear.columns_of(names) for group, names in state.added.items()},
            candidates=len(self.candidates),
            lumped=[group for group in state.added if is_lumped(group)],
            excluding_gusts=[group for group in state.added if _excludes_gusts(state, group)],
        )
        if not taken or not kept:
            return state if kept else replace(state, added={})
        self.reporter.on_message(f"Fitting again without {listed(tuple(taken))}.")
        groups = {name: self.candidates[name] for name in kept}
        return self._pruned(self._refitted(self._without(state, taken), groups))

    def _without(self, state: LinearisedFit, taken: Collection[str]) -> LinearisedFit:
        """Return a fit with some groups removed, the others moved to first order to make up for it.

        Started from their old values, whole flights would diverge.
        """
        space, linear = state.fitted.objective.space, state.linear
        gone = linear.columns_of(names_of({name: self.candidates[name] for name in taken}))
        kept = {name: names for name, names in state.added.items() if name not in taken}
        free = linear.columns_of([*self.job.space.names, *names_of(kept)])
        change = linear.step(free, from_=linear.to_neutral(gone))
        of_flight, offsets = state.fitted.objective.of_flight, np.array(state.fitted.point.offsets)
        for name, unit in zip(of_flight, units_of(of_flight), strict=True):
            if name in condition_names(kept):
                offsets[of_flight.index(name)] += change[linear.columns_of([name])] / unit
        moved = vector_after(
            space, state.fitted.point.coefficients, change[linear.columns_of(space.names)]
        )
        point = Point(np.asarray(moved), np.asarray(offsets))
        return replace(state, fitted=replace(state.fitted, point=point))

    def _refitted(
        self, state: LinearisedFit, groups: Groups, *, anew: bool = False
    ) -> LinearisedFit:
        """Return a rough fit with exactly these groups: the rest of the way is a linear step."""
        return self.linearised(self._fitted(state, groups, anew=anew), groups)

    def _fitted(
        self, state: LinearisedFit, groups: Groups, *, anew: bool = False, roughly: bool = True
    ) -> Fit:
        """Return the fit with exactly these groups, from the last fit's end or from the start."""
        wanted = coefficient_names(groups)
        objective, vector = self._problem(state.fitted, wanted, condition_names(groups))
        new = [group for group in groups if group not in state.added]
        new_ones = [name for group in new for name in groups[group] if name in wanted]
        from_here = replace(
            state.fitted,
            objective=objective,
            point=Point(
                with_start_values(objective.space, vector, new_ones),
                offsets_for(state.fitted, objective),
            ),
        )
        offsets = free_parameters(self.job).offsets
        added = np.ones((len(objective.of_flight) - len(offsets), offsets.shape[1]), bool)
        free_ones = Point(np.ones(len(vector), bool), np.vstack([offsets, added]))
        title = f"with {len(new)} terms more" if new else f"with {len(groups)} terms"

        def on_progress(progress: Progress) -> None:
            self.reporter.on_progress(replace(self.job, space=objective.space), progress)

        stages, start = FIRST_POLISH if roughly else LAST_POLISH, None
        if anew:
            stages = ALL_BUT_LAST
            start = with_start_values(objective.space, objective.space.initial, wanted)
        return polished(
            self.job,
            from_here,
            free=free_ones,
            title=title,
            on_progress=on_progress,
            stages=stages,
            left=ROUGH_TOLERANCE if roughly else None,
            start=start,
        )

    def linearised(self, fitted: Fit, added: Groups) -> LinearisedFit:
        """Return a fit linearised by all candidates."""
        objective, vector = self._problem(
            fitted, coefficient_names(self.candidates), condition_names(self.candidates)
        )
        at = Point(vector, offsets_for(fitted, objective))
        linear = linearise(
            objective,
            at,
            fitted.criterion,
            offsets_fitted=np.asarray(at.offsets) != 0.0,
            conditions=condition_names(self.candidates),
            readings=with_other_readings(objective, at, self.job.fitted).values(),
        )
        return LinearisedFit(fitted, added, linear)

    def _problem(
        self, fitted: Fit, names: Sequence[str], conditions: Sequence[str]
    ) -> tuple[Objective, Array]:
        """Return the base problem with some coefficients free, and a fit's values in it (K,).

        And with some conditions. The model has all candidate terms, at their neutral values.
        """
        objective = with_loop(self.fitted.objective, loop_of(fitted.objective))
        neutral = neutral_values(coefficient_names(self.candidates))
        values = {name: np.asarray(value) for name, value in neutral.items()}
        objective = replace(objective, model=with_coefficients(objective.model, values))
        objective, point = with_terms(objective, self.fitted.point, names, self.job.settings.job)
        objective, point = with_conditions(objective, point, conditions)
        own, pairs = fitted.vector, zip(objective.space.names, point.coefficients, strict=True)
        return objective, np.array([own.get(name, neutral) for name, neutral in pairs])

    def _score(self, state: LinearisedFit, group: str) -> Score:
        """Return the score of a group beside the others in the model."""
        inside, names = group in state.added, self.candidates[group]
        return self._score_of(
            state, names, inside=inside, excludes_gusts=_excludes_gusts(state, group)
        )

    def _rows(self, state: LinearisedFit, dropped: Reasons) -> tuple[SelectionRow, ...]:
        """Return the table: groups in the model first, then by held-out gain."""
        groups = dict.fromkeys([*state.added, *self.candidates])
        scores = {group: self._score(state, group) for group in groups}
        rows = [
            row_of(group, self.candidates[group], group_score, kept=True)
            if group in state.added
            else row_of(group, self.candidates[group], group_score, dropped.get(group), kept=False)
            for group, group_score in scores.items()
        ]
        free = {
            group: names
            for group, names in term_groups().items()
            if group not in self.job.first_terms and set(names) <= set(self.job.space.free)
        }
        rows += self._base_rows(state, free, SelectionCode.OPEN_LOOP)
        rows += self._base_rows(state, self.job.first_terms, SelectionCode.HOVERS_TILTED)
        return tuple(sorted(rows, key=lambda row: (not row.kept, -(row.gain_holdout or 0.0))))

    def rows_of_named(self) -> tuple[SelectionRow, ...]:
        """Return the rows of the terms that the job names, with their scores in the fit."""
        state = self.linearised(self.fitted, {})
        return tuple(self._base_rows(state, self.job.first_terms, SelectionCode.ASKED_FOR))

    def _base_rows(
        self, state: LinearisedFit, groups: Groups, reason: SelectionCode
    ) -> list[SelectionRow]:
        return [
            row_of(group, names, self._score_of(state, names), reason, kept=True)
            for group, names in groups.items()
        ]

    def _score_of(
        self,
        state: LinearisedFit,
        names: Sequence[str],
        *,
        inside: bool = True,
        excludes_gusts: bool = False,
    ) -> Score:
        """Return the score of some coefficients beside all others in the model."""
        others = [*self.job.space.names, *names_of(state.added)]
        linear = state.linear
        return score(
            linear,
            linear.columns_of(name for name in others if name not in names),
            linear.columns_of(names),
            candidates=len(self.candidates),
            inside=inside,
            excludes_gusts=excludes_gusts,
        )

    def _predicts_better(
        self, trial: LinearisedFit, state: LinearisedFit, *, by_flight: bool
    ) -> bool:
        """Return whether a refit predicts held-out flights better than the fit before it.

        By more than the standard error over flights; if only sections of flights support it, not
        worse by more than that.
        """
        scale = state.fitted.criterion.scale
        gains = self._predicted(state, scale) - self._predicted(trial, scale)
        if len(gains) < 2:
            return bool(gains.sum() > 0.0)
        scatter = float(np.sqrt(len(gains)) * np.std(gains, ddof=1))
        return bool(gains.sum() > (scatter if by_flight else -scatter))

    def _predicted(self, state: LinearisedFit, scale: Mapping[str, Array]) -> Array:
        model = state.linear.columns_of([*self.job.space.names, *names_of(state.added)])
        own = state.linear.columns_of(state.fitted.objective.space.names)
        return predicted_losses(state.fitted, state.linear, model, own, scale)


def _excludes_gusts(state: LinearisedFit, group: str) -> bool:
    """Return whether no gust can imitate a group: it reads a signal, or only noise is left."""
    reads = any(COEFFICIENTS[name].reads for name in term_groups().get(group, ()))
    return reads or state.fitted.residuals_at_noise_level


MARKER_GROUPS = ("marker_offset", "marker_tilt")
MIN_HOVER_TILT_RAD = 3e-3
"""Least mean tilt in hover, rad, that frees the markers' frame."""
MIN_TILT_SE = 3.0
"""Standard errors over the flights by which the mean tilt must exceed zero."""
GAIN_TOLERANCE = 0.02
"""Relative difference below which a gain counts as the controller file's."""
GAINS_REFUTED = "Recorded commands have the file's gains: fitting again without {}."


def with_first_terms(job: Job) -> Job:
    """Return the job with the terms free that its search begins with.

    Raises
    ------
    RecordingError
        A term needs the battery's voltage, and a flight has none.
    """
    settings = job.settings.job
    tilt = hover_tilt(job.fitted)
    if not isinstance(settings.terms, str):
        groups = groups_named(settings.terms, job.space)
    elif settings.terms == "auto" and settings.free is None and _hovers_tilted(job, tilt):
        candidates = candidate_groups(job)
        groups = {name: candidates[name] for name in MARKER_GROUPS if name in candidates}
    else:
        groups = {}
    names = [name for group in groups.values() for name in group]
    if not names:
        return job
    if "battery_exponent" in names:
        require_voltage(job.fitted)
    begin = dict(zip(("marker_tilt_x", "marker_tilt_y"), tilt.mean(axis=0), strict=True))
    begin |= {name: row.begin for name in names if (row := COEFFICIENTS[name]).begin is not None}
    values = {name: float(begin.get(name, value)) for name, value in neutral_values(names).items()}
    space = extended(job.space, names, settings, values)
    windows = None if job.windows is None else replace(job.windows, space=space)
    return replace(
        job,
        space=space,
        objective=replace(job.objective, space=space),
        windows=windows,
        first_terms=groups,
    )


def hover_tilt(flights: Sequence[Flight]) -> Array:
    """Return the recorded tilt about x and y, (n, 2) rad, of the flights that begin in hover.

    One row of zeros where none does.
    """
    attitudes = [flight.initial.attitude for flight in flights if is_at_rest(flight.initial)]
    # for an attitude Rz(heading)·tilt, the world's z axis in the body is that of the tilt alone
    tilts = [(2.0 * (w * x + y * z), 2.0 * (w * y - x * z)) for w, x, y, z in attitudes]
    return np.array(tilts or [(0.0, 0.0)])


def _hovers_tilted(job: Job, tilt: Array) -> bool:
    """Return whether the flights of a closed loop agree that their hover is not level."""
    closed = all(INLETS[inlet].closed_loop for inlet in job.inlets)
    if not closed or len(tilt) < 2:
        return False
    mean = np.abs(tilt.mean(axis=0))
    error = tilt.std(axis=0, ddof=1) / np.sqrt(len(tilt))
    return bool(((mean > MIN_HOVER_TILT_RAD) & (mean > MIN_TILT_SE * error)).any())


def search_with_terms(
    job: Job,
    folder: Path,
    *,
    resume: bool,
    reporter: Reporter,
    findings: tuple[Finding, ...] = (),
) -> SelectionResult:
    """Look for the best coefficients of a job, and for the terms that its flights call for.

    Where most flights are far off, terms are tried before the base model is polished, and before
    CMA-ES looks for another start; where flights contradict the fit, none is. Arguments and errors
    are those of `search`. Before terms are tried, the listener gets the search's estimates, or, if
    the search stopped early, findings about gains from recorded commands as doubts.
    """

    def searched(*, resume: bool, provisional: bool) -> SelectionResult:
        with span("search"):
            fitted = search(
                job,
                folder,
                resume=resume,
                on_progress=reporter.on_progress,
                findings=findings,
                provisional=provisional,
            )
        if fitted.polished:
            reporter.listener.on_estimates(point_estimates(job, fitted))
        if _is_refuted(fitted, leaves_flights):
            return SelectionResult(job, fitted, refuted=True)
        if not fitted.polished:
            for finding in gains_far_off(fitted, job.fitted):
                reporter.listener.on_doubt(finding)
        with span("selection of terms"):
            selected = with_terms_selected(job, fitted, reporter)
        return replace(selected, refuted=_is_refuted(selected.fitted, is_refuted))

    selected = searched(resume=resume, provisional=bool(candidates_of(job)))
    if selected.fitted.polished:
        return selected
    return searched(resume=True, provisional=False)


def _is_refuted(fitted: Fit, by: Callable[[Objective, Point, Criterion], bool]) -> bool:
    if fitted.residuals_at_noise_level:
        return False
    return by(fitted.objective, fitted.point, fitted.criterion)


def with_terms_selected(job: Job, fitted: Fit, reporter: Reporter) -> SelectionResult:
    """Return the fit with the terms that the job names, or that the flights select.

    A job with a ``free`` list selects none, unless ``terms`` names some.
    """
    clock, candidates = time.perf_counter(), candidates_of(job)
    selection = Selection(job, fitted, candidates, reporter)
    if not isinstance(job.settings.job.terms, str):
        selected = SelectionResult(job, fitted, selection.rows_of_named())
    elif candidates:
        selected = selection.run()
        if refuted := refuted_by_commands(selected):
            reporter.on_message(GAINS_REFUTED.format(listed(refuted)))
            left = {name: names for name, names in candidates.items() if name not in refuted}
            gone = [row for row in with_refuted(selected, refuted).rows if row.group in refuted]
            without = replace(selection, candidates=left).run()
            selected = replace(without, rows=(*without.rows, *gone))
    else:
        rows = () if job.accelerations is None else job.accelerations.rows
        selected = SelectionResult(job, fitted, rows)
    spent = time.perf_counter() - clock
    return replace(selected, fitted=replace(selected.fitted, wall_time=fitted.wall_time + spent))


def refuted_by_commands(selected: SelectionResult) -> tuple[str, ...]:
    """Return the groups of fitted gains that recorded commands refute.

    In a closed-loop simulation wrong gains may make up for model errors; the regression of recorded
    commands on recorded rates estimates the gains by themselves.
    """
    kept = {row.group: row.names for row in selected.rows if row.kept and row.names[0] in GAIN_AXES}
    fitted = selected.fitted
    answers = answers_of(fitted, selected.job.fitted) if kept else ()
    numbers = fitted.objective.space.numbers(fitted.point.coefficients)

    def matches_file(name: str) -> bool:
        gain = gain_by_commands(name, answers)
        return gain is not None and abs(numbers[name] * gain[0] - 1.0) < GAIN_TOLERANCE

    return tuple(group for group, names in kept.items() if any(map(matches_file, names)))


def with_refuted(selected: SelectionResult, groups: Collection[str]) -> SelectionResult:
    """Return a selection with some groups marked as refuted by recorded commands."""
    refuted = {"kept": False, "reason": SelectionCode.REFUTED}
    rows = (row.model_copy(update=refuted if row.group in groups else {}) for row in selected.rows)
    return replace(selected, rows=tuple(rows))


def candidates_of(job: Job) -> Groups:
    """Return the groups to select from; none where the job has a ``free`` list."""
    settings = job.settings.job
    if settings.terms != "auto" or settings.free is not None:
        return {}
    closed = all(INLETS[inlet].closed_loop for inlet in job.inlets)
    return {**candidate_groups(job), **condition_groups(job.objective, closed_loop=closed)}

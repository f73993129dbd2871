"""Which terms beyond the base model a job's fit holds, and the fit with them.

Forward selection: one Jacobian scores all candidate groups at the fitted point, those that predict
what is left out of the fit are added, all is fitted again, and each flight is predicted by a fit to
the others; groups that do not lower that loss by more than its scatter are dropped. At the end each
group in the model has to earn its place beside the others once more.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from tuner.job.polish import polished
from tuner.job.prepare import Job
from tuner.job.search import OnProgress, free_offsets
from tuner.objective.criterion import OFFSET_SD, Criterion, Point, SegmentSums
from tuner.search.fitted import Fitted
from tuner.search.optimiser import Free
from tuner.selection.candidates import (
    Groups,
    candidate_groups,
    columns_of,
    groups_named,
    start_of,
    with_terms,
)
from tuner.selection.linear import Linear, linear_at
from tuner.selection.score import Score, best_first, score
from tuner.selection.table import SelectionCode, SelectionRow
from tuner.wording.phrases import listed

MAX_ROUNDS = 6
"""Of additions; each round adds all that one linear forward selection finds."""
FAR = 0.2
"""Of the round's first gain: groups that gain less wait until the fit is closer."""
LONGEST_STEP = 1.0
"""Standard deviations of a prior that a coefficient may move when a flight is left out."""


@dataclass(frozen=True)
class Selected:
    """A job and its fit with the terms that were kept, and the table of all that were tried."""

    job: Job
    fitted: Fitted
    rows: tuple[SelectionRow, ...] = ()


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
    settings = job.settings.job
    if not isinstance(settings.terms, str):
        return _as_named(job, fitted, settings.terms, on_progress, on_message)
    candidates = candidate_groups(job.settings.vehicle, job.space, settings)
    if settings.terms == "none" or settings.free is not None or not candidates:
        return Selected(job, fitted)
    return _Selection(job, fitted, candidates, on_progress, on_message).run()


def _as_named(
    job: Job,
    fitted: Fitted,
    terms: Sequence[str],
    on_progress: OnProgress,
    on_message: Callable[[str], None],
) -> Selected:
    """Return the fit with the terms that the job names."""
    groups = groups_named(terms, job.space)
    if not groups:
        return Selected(job, fitted)
    on_message(f"Fitting again with {listed(tuple(groups))}, which the job file names.")
    job, fitted = _refitted(job, fitted, groups, on_progress)
    rows = tuple(
        SelectionRow(group=group, names=names, kept=True, reason=SelectionCode.ASKED_FOR)
        for group, names in groups.items()
    )
    return Selected(job, fitted, rows)


def _refitted(
    job: Job, fitted: Fitted, groups: Groups, on_progress: OnProgress
) -> tuple[Job, Fitted]:
    """Return job and fit with groups freed from their neutral values on, and all polished."""
    job, fitted = _extended(job, fitted, [name for names in groups.values() for name in names])
    return job, _polished(job, fitted, f"with {', '.join(groups)}", on_progress)


def _extended(job: Job, fitted: Fitted, names: Sequence[str]) -> tuple[Job, Fitted]:
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


@dataclass(frozen=True)
class _State:
    """A fit with some groups in it, seen in linear approximation by all that could be in it.

    Attributes
    ----------
    job, fitted
        The fit.
    added
        Groups in it.
    linear
        The loss about it, by its coefficients and, at their neutral values, all other candidates.
    model, columns
        Columns of ``linear``: of its coefficients, and of each candidate group.
    """

    job: Job
    fitted: Fitted
    added: Groups
    linear: Linear
    model: NDArray[np.intp]
    columns: Mapping[str, NDArray[np.intp]]

    def predictions(self, scale: Mapping[str, Array]) -> NDArray[np.float64]:
        """Return the loss (N,) of each flight with the coefficients that the others ask for.

        One linear step leads from the joint fit to the fit without the flight; there the flight is
        simulated. Its own offsets follow.

        Parameters
        ----------
        scale
            Channel -> (N,) factor on the standard deviations.
        """
        objective, fitted = self.fitted.objective, self.fitted
        criterion = _with_scale(fitted.criterion, scale)
        space, flight = objective.space, np.asarray(objective.segments.flight)
        movable, losses = _offsets_fitted(fitted), []
        for number in range(objective.flights):
            change = self.linear.step(self.model, inside=self.linear.flight != number)
            far = LONGEST_STEP * space.prior_sd
            scaled = self.linear.scaled[self.model] + np.clip(change[self.model], -far, far)
            vector = space.at_share((scaled - space.lower) / space.width)
            point = Point(jnp.asarray(vector), fitted.point.offsets)
            sums = objective.sums(point, criterion)
            inside = flight == number
            losses.append(
                float(np.asarray(sums.loss)[inside].sum())
                - _gain_of_offsets(sums, inside, len(space), movable[:, number])
            )
        return np.array(losses)


@dataclass(frozen=True)
class _Selection:
    """A forward selection over some groups."""

    job: Job
    fitted: Fitted
    candidates: Groups
    on_progress: OnProgress
    on_message: Callable[[str], None]

    def run(self) -> Selected:
        """Add groups until none earns its place, then take away those that no longer do."""
        state, dropped = self._seen(self.job, self.fitted, {}), dict[str, SelectionCode]()
        for _ in range(MAX_ROUNDS):
            chosen = self._chosen(state, dropped)
            if not chosen:
                break
            state = self._grown(state, chosen, dropped)
        for _ in range(MAX_ROUNDS):
            scores = self._scores_inside(state)
            idle = [name for name, found in scores.items() if not found.earns_place]
            if not idle:
                break
            least = min(idle, key=lambda name: scores[name].gain_holdout)
            dropped[least] = scores[least].reason
            kept = {name: names for name, names in state.added.items() if name != least}
            state = self._refitted(state, kept)
        return Selected(state.job, state.fitted, self._rows(state, dropped))

    def _chosen(self, state: _State, dropped: Mapping[str, SelectionCode]) -> dict[str, Score]:
        """Return the groups that a linear forward selection adds, those of large gain."""
        left = {
            name: columns
            for name, columns in state.columns.items()
            if name not in state.added and name not in dropped
        }
        chosen = best_first(state.linear, state.model, left, candidates=len(self.candidates))
        most = max((found.gain_holdout for found in chosen.values()), default=0.0)
        return {name: found for name, found in chosen.items() if found.gain_holdout > FAR * most}

    def _grown(
        self, state: _State, chosen: Mapping[str, Score], dropped: dict[str, SelectionCode]
    ) -> _State:
        """Return the state with groups added that predict flights left out, once refitted."""
        best = max(chosen, key=lambda name: chosen[name].gain_holdout)
        for names in dict.fromkeys([tuple(chosen), (best,)]):
            self.on_message(f"Fitting again with {listed(names)}.")
            trial = self._refitted(state, {**state.added, **{n: self.candidates[n] for n in names}})
            by_flight = chosen[best].reason is SelectionCode.PREDICTS_FLIGHTS
            if _predicts_better(trial, state, by_flight=by_flight):
                return trial
        dropped[best] = SelectionCode.WORSE_AFTER_REFIT
        return state

    def _refitted(self, state: _State, groups: Groups) -> _State:
        """Return the fit with exactly these groups, from where the last one ended."""
        names = [name for names in groups.values() for name in names]
        job, fitted = _extended(self.job, self.fitted, names)
        before = dict(
            zip(state.job.space.names, np.asarray(state.fitted.point.coefficients), strict=True)
        )
        start = np.asarray(fitted.point.coefficients)
        vector = [before.get(name, start[i]) for i, name in enumerate(job.space.names)]
        fitted = replace(
            state.fitted,
            objective=fitted.objective,
            outcomes=fitted.outcomes,
            point=Point(jnp.asarray(vector), state.fitted.point.offsets),
        )
        new = [name for name in groups if name not in state.added]
        title = f"with {', '.join(new)}" if new else "with fewer terms"
        fitted = _polished(job, fitted, title, self.on_progress)
        return self._seen(job, fitted, groups)

    def _seen(self, job: Job, fitted: Fitted, added: Groups) -> _State:
        """Return a fit as all candidates see it."""
        names = [
            name for group, names in self.candidates.items() if group not in added for name in names
        ]
        objective, point = with_terms(fitted.objective, fitted.point, names, job.settings.job)
        return _State(
            job=job,
            fitted=fitted,
            added=added,
            linear=linear_at(
                objective, point, fitted.criterion, offsets_fitted=_offsets_fitted(fitted)
            ),
            model=np.arange(len(job.space)),
            columns={
                group: columns_of(objective.space, names)
                for group, names in self.candidates.items()
            },
        )

    def _scores_inside(self, state: _State) -> dict[str, Score]:
        """Return what each group in the model is worth beside the others in it."""
        scores = {}
        for group, names in state.added.items():
            columns = state.columns[group]
            neutral = np.zeros(len(state.linear.scaled))
            neutral[columns] = [
                state.job.space.parameters[column].scaled(value)
                for column, value in zip(columns, start_of(names).values(), strict=True)
            ]
            rest = np.setdiff1d(state.model, columns)
            scores[group] = score(
                state.linear, rest, columns, candidates=len(self.candidates), neutral=neutral
            )
        return scores

    def _rows(
        self, state: _State, dropped: Mapping[str, SelectionCode]
    ) -> tuple[SelectionRow, ...]:
        """Return the table: what is in the model first, by what it predicts."""
        inside = self._scores_inside(state)
        beside = {
            group: score(
                state.linear, state.model, state.columns[group], candidates=len(self.candidates)
            )
            for group in self.candidates
            if group not in state.added
        }
        rows = [
            SelectionRow(
                group=group,
                names=self.candidates[group],
                gain_fit=found.gain_fit,
                gain_holdout=found.gain_holdout,
                scatter=found.scatter,
                kept=group in state.added,
                reason=dropped.get(group, found.reason),
            )
            for group, found in {**inside, **beside}.items()
        ]
        return tuple(sorted(rows, key=lambda row: (not row.kept, -(row.gain_holdout or 0.0))))


def _predicts_better(trial: _State, state: _State, *, by_flight: bool) -> bool:
    """Return whether a refit predicts flights left out better than the fit before it.

    By more than the standard error over the flights, or, where only sections of flights can show
    it, not worse by as much.
    """
    scale = state.fitted.criterion.scale
    gains = state.predictions(scale) - trial.predictions(scale)
    if len(gains) < 2:
        return bool(gains.sum() > 0.0)
    scatter = float(np.sqrt(len(gains)) * np.std(gains, ddof=1))
    return bool(gains.sum() > (scatter if by_flight else -scatter))


def _with_scale(criterion: Criterion, scale: Mapping[str, Array]) -> Criterion:
    return Criterion(
        horizon=criterion.horizon,
        scale=dict(scale),
        reference_offset=criterion.reference_offset,
        huber=criterion.huber,
        prior=criterion.prior,
        states=criterion.states,
    )


def _gain_of_offsets(
    sums: SegmentSums, inside: NDArray[np.bool_], count: int, movable: NDArray[np.bool_]
) -> float:
    """Return by how much a flight's loss falls when its offsets follow, in one linear step."""
    free = count + np.flatnonzero(movable)
    if not len(free):
        return 0.0
    gradient = np.asarray(sums.gradient)[free][:, inside].sum(axis=-1)
    hessian = np.asarray(sums.hessian)[np.ix_(free, free)][..., inside].sum(axis=-1)
    hessian = hessian + np.eye(len(free)) / OFFSET_SD**2
    return float(0.5 * gradient @ np.linalg.solve(hessian, gradient))


def _offsets_fitted(fitted: Fitted) -> NDArray[np.bool_]:
    """Return which offsets (offsets, N) the fit moved: those that are not exactly zero."""
    return np.asarray(np.asarray(fitted.point.offsets) != 0.0)

"""Selection of terms by the innovations of a Kalman filter, once disturbances are estimated.

Least squares sees a term through gusts that the loop has turned into a slow wander of all signals,
and hardly tells it from chance. Innovations are white: they tell the same term up to ten times as
surely. So all candidates are judged once more, in one linear approximation of the innovations.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tuner.disturbances.predictor import Predictor, hidden
from tuner.objective.information import begun
from tuner.objective.space import Space
from tuner.search.findings import findings_at
from tuner.search.problem import Job
from tuner.search.progress import Fitted
from tuner.terms.candidates import (
    Selected,
    is_stand_in,
    names_in,
    presence_of,
    with_free,
    with_groups,
)
from tuner.terms.linearisation import Columns, Linear, linear_of, neutral_of, vector_after
from tuner.terms.model_averaging import SMALLEST, Evidence, in_doubt
from tuner.terms.score import EARNING, score, surviving
from tuner.uncertainty.model_error import Lack
from tuner.vehicle import COEFFICIENTS, conditions
from tuner.vehicle.selection_table import Groups, SelectionCode, SelectionRow

Array = NDArray[np.float64]

REFUSED = (
    SelectionCode.NOT_SIGNIFICANT,
    SelectionCode.IMMATERIAL,
    SelectionCode.NOT_PREDICTED,
    SelectionCode.WORSE_AFTER_REFIT,
)
"""Why least squares may have left out what innovations call for."""
WORTH_A_FIT = 0.05
"""Chance below which a secant lets a term be tried."""
SURELY = 4.0
"""Standard errors by which a coefficient is surely elsewhere."""


@dataclass(frozen=True)
class Innovations:
    """What innovations say of a fit's coefficients and of those of the terms that it lacks.

    Attributes
    ----------
    selected
        The terms of the fit, and those that it lacks.
    fitted
        The fit to the innovations, in the space of ``selected``.
    space, vector
        Of all P coefficients, and where they are.
    linear
        The innovations about it.
    """

    selected: Selected
    fitted: Fitted
    space: Space
    vector: Array
    linear: Linear

    @staticmethod
    def of(
        selected: Selected, fitted: Fitted, predictor: Predictor, lack: Lack | None = None
    ) -> Innovations:
        """Return what the innovations of a predictor say at a fit, gains as they are.

        With what the model lacks acting, where that is known.
        """
        names = [name for group in outside(selected).values() for name in group]
        _, wide = with_free(selected.job, fitted, names)
        objective, beside = wide.objective, replace(predictor, schedule=wide.objective.schedule)
        if lack is not None:
            objective = lack.acting_on(objective)
            beside = beside.stepped(objective)
        information = beside.information(objective, wide.point, fitted.criterion)
        space, vector = objective.space, np.asarray(wide.point.coefficients)
        scaled = space.scaled(vector)
        linear = linear_of(information, scaled, space.prior_mean, predictor.loss)
        linear = replace(linear, names=space.names, neutral=neutral_of(space))
        return Innovations(selected, fitted, space, vector, linear)

    def with_acting(self, lack: Lack | None, predictor: Predictor) -> Innovations:
        """Return what they say with what the model lacks acting.

        What no term explains hides some terms, and passes for others.
        """
        return self if lack is None else Innovations.of(self.selected, self.fitted, predictor, lack)

    def in_doubt(self) -> dict[str, float]:
        """Return how far coefficients would move with terms that were left out.

        Of what set-points hide, by least squares.
        """
        left_out = outside(self.selected)
        groups = [
            (columns, presence_of(names))
            for names in left_out.values()
            if len(columns := self._columns(names))
        ]
        if not groups:
            return dict(self.selected.in_doubt)
        model = self._model(self.fitted.objective.space.names)
        moves = in_doubt(self.linear, model, groups)
        return {
            **self.selected.in_doubt,
            **{self.space.names[i]: float(moves[i]) for i in model},
        }

    def contradict(self, name: str, value: float) -> bool:
        """Return whether they surely put a coefficient that was left out elsewhere, from zero."""
        column = self._columns([name])
        if not len(column) or name in self.fitted.objective.space.names:
            return False
        model = self._model(self.fitted.objective.space.names)
        square = self.linear.information() + self.linear.prior
        told = Evidence.of(self.linear, square, self.linear.step(model), model, column)
        apart = told.value - value / self.linear.prior_sd[column]
        return bool(np.any(apart**2 > SURELY**2 * told.variance))

    def selection(self, had: Collection[str], *, first: bool = False) -> Selected | None:
        """Return the terms that innovations call for and their fit, one linear step on.

        From all that describe one thing, and those that are in already, backwards: what chance
        explains goes first. What is left has to be as large as a term that is not as good as
        absent. None if no other terms are called for, or none was tried.

        What stands in for other terms least squares may have taken for gusts, and from there
        the others look as if they were not needed: ``first`` it goes. Of what is left it is judged
        again, as far as least squares ``had`` it.
        """
        base, tried = self.selected.base, self._tried()
        within = {name: names for name, names in tried.items() if name in self.selected.kept}
        without = {name: names for name, names in within.items() if first and is_stand_in(name)}
        begin = {
            name: names
            for name, names in tried.items()
            if name not in without and (name in within or name in had or not is_stand_in(name))
        }
        if base is None or not (begin or without):
            return None
        judged = names_in(tried)
        model = self._model([n for n in self.fitted.objective.space.names if n not in judged])
        kept, _ = surviving(
            self.linear,
            model,
            {name: self._columns(names) for name, names in begin.items()},
            candidates=len(tried),
            without=self._columns(names_in(without)),
            stand_ins=[name for name in begin if is_stand_in(name)],
            no_gusts=list(begin),  # they are followed
            material=0.0,
            at_once=True,
        )
        change = self._change(model, tried, kept)
        everywhere = np.arange(len(change))
        size = np.abs(change - self.linear.away(everywhere)) / self.linear.prior_sd
        large = [name for name in kept if size[self._columns(tried[name])].max() > SMALLEST]
        if set(large) == set(within):
            return None
        moved = vector_after(self.space, self.vector, self._change(model, tried, large))
        return self._with(base, tried, large, moved)

    def with_lags(self) -> Selected | None:
        """Return the terms with those, too, that begin away from their neutral values, from there.

        No linear approximation judges them, it only tells which are worth a fit. None if none is.
        """
        base = self.selected.base
        model = self._model(self.fitted.objective.space.names)
        lags = {
            row.group: row.names
            for row in self.selected.rows
            if not row.kept
            and row.reason in REFUSED
            and any(name in COEFFICIENTS and COEFFICIENTS[name].begin for name in row.names)
            and score(
                self.linear,
                model,
                self._columns(row.names),
                candidates=1,
                no_gust=True,
                material=0.0,
            ).chance
            < WORTH_A_FIT  # of such innovations if the model did not lack it
        }
        if base is None or not lags:
            return None
        return self._with(base, lags, lags, begun(self.space, self.vector, names_in(lags)))

    def _with(
        self, base: tuple[Job, Fitted], judged: Groups, kept: Collection[str], moved: Array
    ) -> Selected:
        """Return the selection with some of the groups that were judged, at a vector (P,)."""
        rows = [
            _judged(row, kept=row.group in kept) if row.group in judged else row
            for row in self.selected.rows
        ]
        rows.sort(key=lambda row: not row.kept)
        groups = {row.group: row.names for row in rows if row.kept and row.reason in EARNING}
        vector = dict(zip(self.space.names, moved.tolist(), strict=True))
        said = findings_at(self.selected.job, self.selected.fitted)
        job, fitted = with_groups(base, groups, self.fitted, said=said, vector=vector)
        return replace(self.selected, job=job, fitted=fitted, rows=tuple(rows))

    def _tried(self) -> dict[str, tuple[str, ...]]:
        """Return the groups that innovations can judge: all of whose columns they see.

        Not one that at its neutral value does what another coefficient does: their derivatives
        there do not tell it.
        """
        return {
            row.group: row.names
            for row in self.selected.rows
            if row.reason in (EARNING if row.kept else REFUSED)
            and not hidden(row.names).any()
            and not set(row.names) & set(conditions())
            and all(COEFFICIENTS[name].begin is None for name in row.names)
        }

    def _change(self, model: Columns, tried: Groups, kept: Collection[str]) -> Array:
        """Return the step (P,) to the minimum with some groups, the others at neutral values."""
        free = np.concatenate([model, *(self._columns(tried[name]) for name in kept)])
        gone = [name for group in set(tried) - set(kept) for name in tried[group]]
        return self.linear.step(free.astype(np.intp), from_=self.linear.away(self._columns(gone)))

    def _model(self, names: Sequence[str]) -> Columns:
        """Return the columns of what the model holds anyway, and innovations see."""
        return self._columns([name for name in names if name not in self.fitted.held])

    def _columns(self, names: Sequence[str]) -> Columns:
        seen = ~hidden(self.space.names)
        return np.flatnonzero(np.isin(self.space.names, list(names)) & seen)


def outside(selected: Selected) -> Groups:
    """Return what was tried and left out. A steady wind is a disturbance like others."""
    around = set(conditions())
    return {names[0]: names for names in selected.left_out if not around & set(names)}


def _judged(row: SelectionRow, *, kept: bool) -> SelectionRow:
    """Return a group's row after innovations have judged it."""
    if row.kept == kept:
        return row
    reason = SelectionCode.PREDICTS_SAMPLES if kept else SelectionCode.NOT_SIGNIFICANT
    return row.model_copy(update={"kept": kept, "reason": reason})

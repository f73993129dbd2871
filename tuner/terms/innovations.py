"""Selection of terms by the innovations of a Kalman filter, once disturbances are estimated.

In the residuals of a simulation, gusts are a slow wander of all signals, and a term hardly stands
out from it. Innovations are white: the same term has up to a tenth of the standard error. So all
candidates are tested once more, in one linear approximation of the innovations.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tuner.core.numerics import Array
from tuner.disturbances.predictor import Predictor, hidden_by_setpoints
from tuner.objective.information import with_start_values
from tuner.objective.space import Space
from tuner.search.problem import Job
from tuner.search.progress import Fitted
from tuner.terms.candidates import (
    Selected,
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
from tuner.terms.model_averaging import NEGLIGIBLE_SIZE, Evidence, selection_shifts
from tuner.terms.score import ACCEPTED, backward_elimination, score
from tuner.uncertainty.model_error import ModelErrors
from tuner.vehicle import COEFFICIENTS, condition_rows
from tuner.vehicle.selection_table import Groups, SelectionCode, SelectionRow

REJECTED_BY_LEAST_SQUARES = (
    SelectionCode.NOT_SIGNIFICANT,
    SelectionCode.IMMATERIAL,
    SelectionCode.NOT_PREDICTED,
    SelectionCode.WORSE_AFTER_REFIT,
)
"""Reasons of least squares that innovations may overrule."""
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

    selected: Selected
    fitted: Fitted
    space: Space
    vector: Array
    linear: LinearisedLoss

    @staticmethod
    def of(
        selected: Selected,
        fitted: Fitted,
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

    def selection_shifts(self) -> dict[str, float]:
        """Return by how much omitted terms would shift each coefficient.

        The shifts of coefficients that set-points hide are those of least squares.
        """
        left_out = groups_left_out(self.selected)
        groups = [
            (columns, prior_presence_of(names))
            for names in left_out.values()
            if len(columns := self._columns(names))
        ]
        if not groups:
            return dict(self.selected.selection_shifts)
        model = self._model(self.fitted.objective.space.names)
        moves = selection_shifts(self.linear, model, groups)
        own = {self.space.names[i]: float(moves[i]) for i in model}
        return {**self.selected.selection_shifts, **own}

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

    def selection(self, had: Collection[str], *, first: bool = False) -> Selected | None:
        """Return the terms that innovations select and their fit, one linear step on.

        Backward elimination starts from all terms but lumped ones, and those already in the fit.
        The survivors must exceed a negligible size. None if the selection stays the same, or none
        was tried.

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
            without_refits=True,
        )
        change = self._change(model, tried, kept)
        everywhere = np.arange(len(change))
        size = np.abs(change - self.linear.to_neutral(everywhere)) / self.linear.prior_sd
        large = [name for name in kept if size[self._columns(tried[name])].max() > NEGLIGIBLE_SIZE]
        if set(large) == set(within):
            return None
        moved = vector_after(self.space, self.vector, self._change(model, tried, large))
        return self._with(base, tried, large, moved)

    def with_lag_terms(self) -> Selected | None:
        """Return the terms with lags added, which start away from their neutral values.

        No linear approximation tests them; it only shows which are worth a fit. None if none is.
        """
        base = self.selected.base
        model = self._model(self.fitted.objective.space.names)
        lags = {
            row.group: row.names
            for row in self.selected.rows
            if not row.kept
            and row.reason in REJECTED_BY_LEAST_SQUARES
            and any(name in COEFFICIENTS and COEFFICIENTS[name].begin for name in row.names)
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
        self, base: tuple[Job, Fitted], judged: Groups, kept: Collection[str], moved: Array
    ) -> Selected:
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
            and not hidden_by_setpoints(row.names).any()
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
        seen = ~hidden_by_setpoints(self.space.names)
        return np.flatnonzero(np.isin(self.space.names, list(names)) & seen)


def groups_left_out(selected: Selected) -> Groups:
    """Return the groups left out but per-flight conditions: a filter estimates steady wind too."""
    return {names[0]: names for names in selected.left_out if not {*condition_rows()} & {*names}}


def _row_after(row: SelectionRow, *, kept: bool) -> SelectionRow:
    """Return a group's row after its test by innovations."""
    if row.kept == kept:
        return row
    reason = SelectionCode.PREDICTS_SAMPLES if kept else SelectionCode.NOT_SIGNIFICANT
    return row.model_copy(update={"kept": kept, "reason": reason})

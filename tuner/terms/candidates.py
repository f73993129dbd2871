"""Candidate terms: the groups that a fit may add, problems with them free, and the selection."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from tuner.config import JobFile
from tuner.core.numerics import Array
from tuner.objective.criterion import Point
from tuner.objective.inlets import bypassed_by
from tuner.objective.normal_equations import Objective, with_conditions
from tuner.objective.space import Space, extended
from tuner.search.problem import Job
from tuner.search.progress import Fit, loop_of, with_loop
from tuner.terms.score import ACCEPTED
from tuner.vehicle import COEFFICIENTS, condition_rows, term_groups, values_of
from tuner.vehicle.selection_table import Groups, SelectionCode, SelectionRow

PRIOR_PRESENCE = 0.5
"""Prior probability that a vehicle has an effect large enough to be seen: no preference."""
PRIOR_PRESENCE_OF_LUMPED = 0.1
"""The same for a lumped group: other candidates describe its effect term by term, more likely."""


def candidate_groups(job: Job) -> Groups:
    """Return the groups that act, none of whose coefficients is given, free or fixed."""
    values, groups = values_of(job.settings.vehicle), term_groups()
    taken = {*job.space.free, *job.settings.job.fixed, *bypassed_by(job.inlets, job.fitted)}
    return {
        group: names
        for group, names in groups.items()
        if not taken.intersection(names)
        and all(values.get(name) in (None, COEFFICIENTS[name].unselected) for name in names)
    }


def condition_groups(objective: Objective, *, closed_loop: bool) -> Groups:
    """Return the groups of per-flight conditions (wind, battery) that a fit may add.

    They are nuisance parameters with a value for each flight: wind where flights are simulated
    whole in closed loop (over a window, the initial state explains as much), and there a battery's
    decline if no voltage was recorded.
    """
    if not closed_loop:
        return {}
    groups: dict[str, tuple[str, ...]] = {"wind": ("wind_x", "wind_y")}
    if objective.segments.log_voltage is None:
        groups["battery_decline"] = ("battery_decline",)
    return {
        group: names
        for group, names in groups.items()
        if not set(names).intersection(objective.conditions)
    }


def names_of(groups: Groups) -> tuple[str, ...]:
    """Return the names in some groups: coefficients and per-flight conditions."""
    return tuple(name for names in groups.values() for name in names)


def coefficient_names(groups: Groups) -> tuple[str, ...]:
    """Return the coefficients of some groups."""
    return tuple(name for name in names_of(groups) if name not in condition_rows())


def condition_names(groups: Groups) -> tuple[str, ...]:
    """Return the per-flight conditions of some groups."""
    return tuple(name for name in names_of(groups) if name in condition_rows())


def groups_named(terms: Sequence[str], space: Space) -> Groups:
    """Return the groups, or coefficients, that a job file names and that are not free yet.

    Per-flight conditions are not among them: those are estimated from the start of the search.
    """
    groups = term_groups()
    named: dict[str, tuple[str, ...]] = {}
    taken = {*space.free, *condition_rows()}
    for term in terms:
        members = groups.get(term, (term,) if term in COEFFICIENTS else ())
        names = tuple(name for name in members if name not in taken)
        if names:
            named[term] = names
            taken.update(names)
    return named


def is_lumped(group: str) -> bool:
    """Return whether a group lumps effects that other terms describe one by one."""
    return any(COEFFICIENTS[name].is_aggregate for name in term_groups().get(group, ()))


def prior_presence_of(names: Collection[str]) -> float:
    """Return the prior probability that a vehicle has a group in a size that flights can show."""
    rows = [COEFFICIENTS[name] for name in names if name in COEFFICIENTS]
    if any(row.expected for row in rows):
        return 1.0
    return PRIOR_PRESENCE_OF_LUMPED if any(row.is_aggregate for row in rows) else PRIOR_PRESENCE


def neutral_values(names: Sequence[str]) -> dict[str, float]:
    """Return the neutral values of some coefficients; each of a term has one, or one by law."""
    return {n: value for n in names if (value := COEFFICIENTS[n].unselected) is not None}


def with_terms(
    objective: Objective, point: Point, names: Sequence[str], job: JobFile
) -> tuple[Objective, Point]:
    """Return a problem with more coefficients free, and its point with them at neutral values."""
    if not names:
        return objective, point
    space = extended(objective.space, names, job, neutral_values(names))
    return replace(objective, space=space), Point(
        np.concatenate([np.asarray(point.coefficients), np.asarray(space.initial[-len(names) :])]),
        point.offsets,
    )


def with_free(
    job: Job, fitted: Fit, names: Sequence[str], *, conditions_added: Sequence[str] = ()
) -> tuple[Job, Fit]:
    """Return job and fit with more coefficients and conditions free, at neutral values."""
    objective, point = with_terms(fitted.objective, fitted.point, names, job.settings.job)
    objective, point = with_conditions(objective, point, conditions_added)
    return (
        replace(
            job,
            space=objective.space,
            objective=replace(
                job.objective, space=objective.space, conditions=objective.conditions
            ),
        ),
        replace(fitted, objective=objective, point=point),
    )


def with_groups(
    base: tuple[Job, Fit],
    groups: Groups,
    fitted: Fit,
    *,
    vector: Mapping[str, float] | None = None,
) -> tuple[Job, Fit]:
    """Return a base job with some groups added, and its fit at the values of another fit.

    Parameters
    ----------
    base
        Job and fit without any groups.
    groups
        The groups to add.
    fitted
        The fit whose values are taken.
    vector
        Coefficient -> value in the search vector; that of ``fitted`` by default.
    """
    job, grown = with_free(
        *base, coefficient_names(groups), conditions_added=condition_names(groups)
    )
    vector = fitted.vector if vector is None else vector
    moved = replace(
        fitted,
        objective=with_loop(grown.objective, loop_of(fitted.objective)),
        point=Point(
            np.asarray([vector[name] for name in job.space.names]),
            offsets_for(fitted, grown.objective),
        ),
    )
    return job, moved


def offsets_for(fitted: Fit, objective: Objective) -> Array:
    """Return a fit's offsets as rows of another problem of the same flights; new ones are zero."""
    rows = np.asarray(fitted.point.offsets)
    by_name = dict(zip(fitted.objective.of_flight, rows, strict=True))
    zeros = np.zeros(rows.shape[1])
    return np.stack([by_name.get(name, zeros) for name in objective.of_flight])


@dataclass(frozen=True)
class SelectionResult:
    """A job and its fit with the terms that were kept, and the table of all that were tried.

    Attributes
    ----------
    selection_shifts
        Coefficient -> its root mean square shift, scaled, by terms that were tried and not kept
        (`selection_shifts`); empty if none was tried.
    base
        Job and fit without any term; None if none was tried.
    refuted
        Whether the flights contradict the fit: neither terms nor disturbances explain them.
    substitutes
        Kept group -> values of coefficients that were left out and that flights do not exclude in
        its place.
    """

    job: Job
    fitted: Fit
    rows: tuple[SelectionRow, ...] = ()
    selection_shifts: Mapping[str, float] = field(default_factory=dict)
    base: tuple[Job, Fit] | None = None
    refuted: bool = False
    substitutes: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    @property
    def kept(self) -> tuple[str, ...]:
        """The groups that are in the fit."""
        return tuple(row.group for row in self.rows if row.kept)

    @property
    def left_out(self) -> tuple[tuple[str, ...], ...]:
        """Names of each group that was tried and not kept, if the flights determine it."""
        return tuple(
            row.names
            for row in self.rows
            if not row.kept and row.reason is not SelectionCode.NO_INFORMATION
        )

    @property
    def rows_after_holding(self) -> tuple[SelectionRow, ...]:
        """The table, with chosen terms not kept if all their coefficients are held."""
        return tuple(
            row.model_copy(update={"kept": False, "reason": SelectionCode.NO_INFORMATION})
            if row.reason in ACCEPTED
            and all(self.fitted.held.get(name) == name for name in row.names)
            else row
            for row in self.rows
        )

"""Candidate terms: the groups that a fit may add, problems with them free, and what is selected."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sim_jax.numeric import Array
from tuner.config import JobFile
from tuner.findings.findings import Finding
from tuner.objective.criterion import Point
from tuner.objective.normal_equations import Objective, with_conditions
from tuner.objective.space import Space, extended
from tuner.search.findings import findings_at
from tuner.search.problem import Job
from tuner.search.progress import Fitted, loop_of, with_loop
from tuner.terms.score import EARNING
from tuner.vehicle import COEFFICIENTS, conditions, term_groups, values_of
from tuner.vehicle.selection_table import Groups, SelectionCode, SelectionRow

PRESENT = 0.5
"""Probability a priori that a vehicle has an effect in a size that flights could tell."""
STANDS_IN = 0.1
"""That it has what one group describes as a whole and others, candidates beside it, one by one."""


def candidate_groups(job: Job) -> Groups:
    """Return the groups that may be added: no coefficient of theirs is given, free or fixed."""
    given, groups = values_of(job.settings.vehicle), term_groups()
    taken = {*job.space.free, *job.settings.job.fixed}
    return {
        group: names
        for group, names in groups.items()
        if not taken.intersection(names)
        and all(given.get(name) in (None, COEFFICIENTS[name].neutral) for name in names)
    }


def groups_around(objective: Objective, *, closed_loop: bool) -> Groups:
    """Return the groups of what may surround each flight, that a fit may add.

    They are nuisances with a value for each flight: the wind of flights that are flown whole in
    their closed loop (over a window, the start explains as much), and there the decline of a
    battery where no voltage was recorded.
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


def groups_in(space: Space, others: Collection[str]) -> Groups:
    """Return the groups of terms that are wholly free, but for others."""
    return {
        group: names
        for group, names in term_groups().items()
        if group not in others and set(names) <= set(space.free)
    }


def names_in(groups: Groups) -> tuple[str, ...]:
    """Return all that some groups hold: coefficients, and what surrounds each flight."""
    return tuple(name for names in groups.values() for name in names)


def coefficients_in(groups: Groups) -> tuple[str, ...]:
    """Return the coefficients of some groups."""
    around = conditions()
    return tuple(name for name in names_in(groups) if name not in around)


def conditions_in(groups: Groups) -> tuple[str, ...]:
    """Return what of some groups surrounds each flight."""
    around = conditions()
    return tuple(name for name in names_in(groups) if name in around)


def groups_named(terms: Sequence[str], space: Space) -> Groups:
    """Return the groups, or coefficients, that a job file names and that are not free yet.

    What surrounds a flight is none of them: it is estimated from the start of the search on.
    """
    groups = term_groups()
    named: dict[str, tuple[str, ...]] = {}
    taken = {*space.free, *conditions()}
    for term in terms:
        members = groups.get(term, (term,) if term in COEFFICIENTS else ())
        names = tuple(name for name in members if name not in taken)
        if names:
            named[term] = names
            taken.update(names)
    return named


def is_stand_in(group: str) -> bool:
    """Return whether a group describes as a whole what other terms do one by one."""
    return any(COEFFICIENTS[name].stands_in for name in term_groups().get(group, ()))


def presence_of(names: Collection[str]) -> float:
    """Return the probability a priori that a vehicle has a group of these coefficients.

    In a size that flights could tell: from what is as good as absent on.
    """
    rows = [COEFFICIENTS[name] for name in names if name in COEFFICIENTS]
    if any(row.expected for row in rows):
        return 1.0
    return STANDS_IN if any(row.stands_in for row in rows) else PRESENT


def reads_recording(group: str) -> bool:
    """Return whether a group's law reads a recorded signal, which gusts do not shape."""
    return any(COEFFICIENTS[name].reads for name in term_groups().get(group, ()))


def start_of(names: Sequence[str]) -> dict[str, float]:
    """Return the neutral value of each coefficient of a term."""
    values = {}
    for name in names:
        neutral = COEFFICIENTS[name].neutral
        assert neutral is not None, "a term's coefficient has a neutral value"
        values[name] = neutral
    return values


def with_terms(
    objective: Objective, point: Point, names: Sequence[str], job: JobFile
) -> tuple[Objective, Point]:
    """Return a problem with more coefficients free, and its point with them at neutral values."""
    if not names:
        return objective, point
    space = extended(objective.space, names, job, start_of(names))
    return replace(objective, space=space), Point(
        np.concatenate([np.asarray(point.coefficients), np.asarray(space.initial[-len(names) :])]),
        point.offsets,
    )


def with_free(
    job: Job, fitted: Fitted, names: Sequence[str], *, around: Sequence[str] = ()
) -> tuple[Job, Fitted]:
    """Return job and fit with some coefficients free, at their neutral values.

    ``around`` is what surrounds each flight and is estimated from now on; it begins as nothing.
    """
    objective, point = with_terms(fitted.objective, fitted.point, names, job.settings.job)
    objective, point = with_conditions(objective, point, around)
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
    base: tuple[Job, Fitted],
    groups: Groups,
    fitted: Fitted,
    *,
    said: Collection[Finding],
    vector: Mapping[str, float] | None = None,
) -> tuple[Job, Fitted]:
    """Return a base job with some groups in it, and its fit at the numbers of another one.

    Parameters
    ----------
    base
        Job and fit without any groups.
    groups
        What is free beside the base model.
    fitted
        Where the fit with the groups is.
    said
        What that fit's findings say of its own coefficients.
    vector
        Coefficient -> number of the search vector, where it is not the fit's own.
    """
    job, grown = with_free(*base, coefficients_in(groups), around=conditions_in(groups))
    vector = fitted.vector if vector is None else vector
    there = replace(
        fitted,
        objective=with_loop(grown.objective, loop_of(fitted.objective)),
        point=Point(
            np.asarray([vector[name] for name in job.space.names]),
            offsets_of(fitted, grown.objective),
        ),
    )
    others = [finding for finding in fitted.findings if finding not in said]
    return job, replace(there, findings=(*others, *findings_at(job, there)))


def offsets_of(fitted: Fitted, objective: Objective, *, gone: Collection[str] = ()) -> Array:
    """Return a fit's offsets, without some, as the rows of another problem of the same flights."""
    rows = np.asarray(fitted.point.offsets)
    known = dict(zip(fitted.objective.of_flight, rows, strict=True))
    known = {name: row for name, row in known.items() if name not in gone}
    nothing = np.zeros(rows.shape[1])
    return np.asarray(np.stack([known.get(name, nothing) for name in objective.of_flight]))


@dataclass(frozen=True)
class Selected:
    """A job and its fit with the terms that were kept, and the table of all that were tried.

    Attributes
    ----------
    in_doubt
        Coefficient -> how far it would move, in the scaled coordinate, with terms that were tried
        and not kept; empty where none was tried.
    base
        Job and fit without any of them; None where none was tried.
    refuted
        Whether its flights contradict the fit: neither terms nor disturbances explain those.
    """

    job: Job
    fitted: Fitted
    rows: tuple[SelectionRow, ...] = ()
    in_doubt: Mapping[str, float] = field(default_factory=dict)
    base: tuple[Job, Fitted] | None = None
    refuted: bool = False

    @property
    def kept(self) -> tuple[str, ...]:
        """The groups that are in the fit."""
        return tuple(row.group for row in self.rows if row.kept)

    @property
    def left_out(self) -> tuple[tuple[str, ...], ...]:
        """Names of each group that was tried and not kept, if the flights say anything of it."""
        return tuple(
            row.names
            for row in self.rows
            if not row.kept and row.reason is not SelectionCode.NO_INFORMATION
        )

    def rows_given(self, held: Mapping[str, str]) -> tuple[SelectionRow, ...]:
        """Return the table once coefficients are held: a term that was chosen and is, is out.

        ``held`` is a coefficient -> its stand-in, as of `tuner.search.progress.Fitted`.
        """
        return tuple(
            row.model_copy(update={"kept": False, "reason": SelectionCode.NO_INFORMATION})
            if row.reason in EARNING and all(held.get(name) == name for name in row.names)
            else row
            for row in self.rows
        )

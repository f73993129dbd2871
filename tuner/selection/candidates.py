"""Which groups of coefficients a fit may add, and its problem with all of them in it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import jax.numpy as jnp

from tuner.coefficients import COEFFICIENTS, conditions, term_groups
from tuner.coefficients.space import Space, extended
from tuner.config import JobFile, VehicleFile, values_of
from tuner.objective.criterion import Point
from tuner.objective.normal import Objective

Groups = Mapping[str, tuple[str, ...]]
"""Group -> its coefficients."""


def candidate_groups(vehicle: VehicleFile, space: Space, job: JobFile) -> Groups:
    """Return the groups that may be added: no coefficient of theirs is given, free or fixed."""
    given, groups = values_of(vehicle), term_groups()
    taken = {*space.free, *job.fixed}
    return {
        group: names
        for group, names in groups.items()
        if not taken.intersection(names)
        and all(given.get(name) in (None, COEFFICIENTS[name].neutral) for name in names)
    }


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
    return any(COEFFICIENTS[name].stands_in for name in term_groups()[group])


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
        jnp.concatenate(
            [jnp.asarray(point.coefficients), jnp.asarray(space.initial[-len(names) :])]
        ),
        point.offsets,
    )

"""A problem's flights, as many at a time as the Jacobian of fits the memory."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import equinox as eqx
import jax
import numpy as np
from numpy.typing import NDArray

from tuner.objective.criterion import Criterion, Point
from tuner.objective.normal import Objective

Flights = NDArray[np.intp]


def portions(objective: Objective, point: Point, criterion: Criterion) -> Iterator[Flights]:
    """Return the numbers of flights that follow each other and fit the objective's memory.

    A flight alone is taken however large it is.
    """
    sizes = np.bincount(np.asarray(objective.segments.flight)) * _bytes_a_segment(
        objective, point, criterion
    )
    first, taken = 0, 0
    for number, size in enumerate(sizes):
        if number > first and taken + size > objective.memory:
            yield np.arange(first, number)
            first, taken = number, 0
        taken += size
    yield np.arange(first, len(sizes))


def _bytes_a_segment(objective: Objective, point: Point, criterion: Criterion) -> int:
    starts = 0 if criterion.states is None else len(criterion.states)
    columns = len(objective.space) + len(point.offsets) + starts
    measured = objective.segments.measured.values()
    compared = sum(int(np.prod(np.shape(m.weight)[:2])) for m in measured)
    return 8 * (columns + 1) * compared


def portion(
    objective: Objective, point: Point, criterion: Criterion, flights: Flights
) -> tuple[Objective, Point, Criterion]:
    """Return problem, point and criterion of some flights alone."""
    flight = np.asarray(objective.segments.flight)
    segments = np.flatnonzero(np.isin(flight, flights))
    kept = jax.tree.map(
        lambda leaf: np.asarray(np.asarray(leaf)[..., segments]), objective.segments
    )
    kept = eqx.tree_at(
        lambda k: k.flight, kept, np.asarray(np.searchsorted(flights, flight[segments]))
    )
    return (
        eqx.tree_at(lambda o: o.segments, objective, kept),
        Point(point.coefficients, point.offsets[:, flights]),
        replace(
            criterion,
            scale={name: scale[flights] for name, scale in criterion.scale.items()},
            reference_offset=criterion.reference_offset[:, flights],
            states=None if criterion.states is None else criterion.states[:, segments],
        ),
    )

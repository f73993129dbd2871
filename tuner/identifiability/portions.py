"""A problem's flights, as many at a time as the Jacobian of fits the memory."""

from __future__ import annotations

from collections.abc import Iterator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from tuner.objective.normal import Objective
from tuner.objective.terms import Point, Stage

Flights = NDArray[np.intp]


def portions(objective: Objective, point: Point, stage: Stage) -> Iterator[Flights]:
    """Return the numbers of flights that follow each other and fit the objective's memory.

    A flight alone is taken however large it is.
    """
    sizes = np.bincount(np.asarray(objective.lanes.flight)) * _bytes_a_lane(objective, point, stage)
    first, taken = 0, 0
    for number, size in enumerate(sizes):
        if number > first and taken + size > objective.memory:
            yield np.arange(first, number)
            first, taken = number, 0
        taken += size
    yield np.arange(first, len(sizes))


def _bytes_a_lane(objective: Objective, point: Point, stage: Stage) -> int:
    starts = 0 if stage.states is None else len(stage.states)
    columns = len(objective.space) + len(point.offsets) + starts
    measured = objective.lanes.measured.values()
    compared = sum(int(np.prod(np.shape(m.weight)[:2])) for m in measured)
    return 8 * (columns + 1) * compared


def portion(
    objective: Objective, point: Point, stage: Stage, flights: Flights
) -> tuple[Objective, Point, Stage]:
    """Return problem, point and stage of some flights alone."""
    flight = np.asarray(objective.lanes.flight)
    lanes = np.flatnonzero(np.isin(flight, flights))
    kept = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)[..., lanes]), objective.lanes)
    kept = eqx.tree_at(
        lambda k: k.flight, kept, jnp.asarray(np.searchsorted(flights, flight[lanes]))
    )
    return (
        eqx.tree_at(lambda o: o.lanes, objective, kept),
        Point(point.coefficients, point.offsets[:, flights]),
        Stage(
            horizon=stage.horizon,
            scale={name: scale[flights] for name, scale in stage.scale.items()},
            held=stage.held[:, flights],
            huber=stage.huber,
            prior=stage.prior,
            states=None if stage.states is None else stage.states[:, lanes],
        ),
    )

"""Many coefficient vectors at once: how closely each meets the recordings, axis by axis."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from tuner.engine import Report, current
from tuner.objective.criterion import Criterion, Point, SegmentData, SegmentSums
from tuner.objective.normal import Objective
from tuner.objective.residuals import residuals, robust

CHUNK = 16
"""Vectors simulated side by side: enough to fill the processor, few enough for its memory."""


class Batch(eqx.Module):
    """What S vectors give.

    Attributes
    ----------
    loss
        (S, F) half the robust sum of squares.
    squares
        Channel -> (S, k, F) plain sum of squares in unscaled standard deviations.
    crash_time
        (S, F) s, infinite for a segment that flew.
    """

    loss: Float[NDArray[np.float64], "S F"]
    squares: dict[str, Float[NDArray[np.float64], "S k F"]]
    crash_time: Float[NDArray[np.float64], "S F"]


def evaluate(
    objective: Objective, vectors: NDArray[np.float64], point: Point, criterion: Criterion
) -> Batch:
    """Fly all segments with every vector, in chunks that fit the memory.

    The engine in force computes them.

    Parameters
    ----------
    objective, criterion
        The problem.
    vectors
        (S, K) search vectors.
    point
        Its clock offsets hold for all.
    """
    engine = current()
    problem = engine.share((objective, point, criterion))
    chunks = [vectors[first : first + CHUNK] for first in range(0, len(vectors), CHUNK)]
    parts = engine.map(_evaluated, [(problem, chunk) for chunk in chunks])
    joined: Batch = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    return joined


def _evaluated(
    task: tuple[Callable[[], tuple[Objective, Point, Criterion]], NDArray[np.float64]],
    _report: Report,
) -> Batch:
    """Return what some vectors give: all segments of all vectors fly side by side."""
    (objective, point, criterion), vectors = task[0](), task[1]
    simulator, count = objective.simulator, len(vectors)
    segments = objective.segments.count
    data: SegmentData = jax.tree.map(
        lambda leaf: np.tile(leaf, count), objective.data(point.offsets, criterion)
    )
    horizon, together = int(criterion.horizon), count * segments
    flown = simulator.fly(data, objective.tunable, np.repeat(vectors, segments, axis=0), horizon)
    reading = simulator.reading(data, horizon)
    loss, squares = np.zeros(together), {}
    for name, measured in data.segments.measured.items():
        scale = np.asarray(data.scale[name])
        by_axis = np.zeros((together, np.shape(measured.weight)[1]))
        for block in residuals(flown, data.segments, name, reading):
            scaled = block.errors / scale[block.segments, None, None]
            loss[block.segments] += 0.5 * robust(scaled, float(criterion.huber)).sum(axis=(1, 2))
            by_axis[block.segments] += np.einsum("fnk,fnk->fk", block.errors, block.errors)
        squares[name] = np.moveaxis(by_axis.reshape(count, segments, -1), -1, 1)
    return Batch(loss.reshape(count, segments), squares, flown.crash_time.reshape(count, segments))


_Problem = Callable[[], tuple[Objective, Criterion, bool]]


def sums_at(
    objective: Objective, points: Point, criterion: Criterion, *, derivatives: bool = True
) -> SegmentSums:
    """Return every segment's contribution at S points, as `Objective.sums_of` does.

    The engine in force computes them, a task each; one alone stays here.
    """
    if len(points.coefficients) == 1:
        return objective.sums_of(points, criterion, derivatives=derivatives)
    engine = current()
    problem = engine.share((objective, criterion, derivatives))
    alone = [
        Point(coefficients[None], offsets[None])
        for coefficients, offsets in zip(points.coefficients, points.offsets, strict=True)
    ]
    parts = engine.map(_sums, [(problem, point) for point in alone])
    joined: SegmentSums = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    return joined


def _sums(task: tuple[_Problem, Point], _report: Report) -> SegmentSums:
    problem, point = task
    objective, criterion, derivatives = problem()
    flown = objective.sums_of(point, criterion, derivatives=derivatives)
    sums: SegmentSums = jax.tree.map(np.asarray, flown)
    return sums

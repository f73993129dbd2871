"""Many coefficient vectors at once: how closely each meets the recordings, axis by axis."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from tuner.engine import Report, current
from tuner.objective.criterion import Criterion, Point, SegmentSums
from tuner.objective.normal import Objective, some_segments
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
    count, segments = len(vectors), objective.segments.count
    together = np.tile(np.arange(segments), count)
    objective, criterion = some_segments(objective, criterion, together)
    point = Point(np.repeat(vectors, segments, axis=0), point.offsets)
    flown, reading = objective.fly(point, criterion), objective.reading(point, criterion)
    loss, squares = np.zeros(len(together)), {}
    for name, measured in objective.segments.measured.items():
        scale = criterion.scale[name][objective.flight]
        by_axis = np.zeros((len(together), np.shape(measured.weight)[1]))
        for block in residuals(flown, objective.segments, name, reading):
            scaled = block.errors / scale[block.segments, None, None]
            loss[block.segments] += 0.5 * robust(scaled, criterion.huber).sum(axis=(1, 2))
            by_axis[block.segments] += np.einsum("fnk,fnk->fk", block.errors, block.errors)
        squares[name] = np.moveaxis(by_axis.reshape(count, segments, -1), -1, 1)
    return Batch(loss.reshape(count, segments), squares, flown.crash_time.reshape(count, segments))


def sums_at(
    objective: Objective, points: Point, criterion: Criterion, *, derivatives: bool = True
) -> SegmentSums:
    """Return every segment's contribution at S points; all leaves have S first.

    The engine in force computes them, a task each; one alone stays here.
    """
    alone = [
        Point(coefficients, offsets)
        for coefficients, offsets in zip(points.coefficients, points.offsets, strict=True)
    ]
    if len(alone) == 1:
        parts = [objective.sums(alone[0], criterion, derivatives=derivatives)]
    else:
        engine = current()
        problem = engine.share((objective, criterion, derivatives))
        parts = engine.map(_sums, [(problem, point) for point in alone])
    joined: SegmentSums = jax.tree.map(lambda *leaves: np.stack(leaves), *parts)
    return joined


def _sums(
    task: tuple[Callable[[], tuple[Objective, Criterion, bool]], Point], _report: Report
) -> SegmentSums:
    (objective, criterion, derivatives), point = task[0](), task[1]
    return objective.sums(point, criterion, derivatives=derivatives)

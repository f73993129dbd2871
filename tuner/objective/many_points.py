"""Several points of one problem, each by itself: here in turn, or beside each other elsewhere.

A program that computes several points in a row rounds otherwise than one that computes one. All
take the latter, so that a point's sums do not depend on how many others there are, nor on where
they are computed; and it is compiled already, for the search from one start takes it, too.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import numpy as np

from tuner.engine import Report, current
from tuner.objective.criterion import Criterion, Point, SegmentSums
from tuner.objective.normal import Objective

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

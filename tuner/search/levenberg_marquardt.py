"""Levenberg-Marquardt for several starts at once, one step at a time.

About the best point so far the loss is the quadratic of its normal equations, c + gᵀd + ½ dᵀHd. The
next point to be tried lies at d = -(H + λI)⁻¹ g. It is accepted if the loss falls by more than a
twentieth of what the quadratic says; λ is then kept, or divided by five where it falls by more than
0.7 of that (Madsen, Nielsen and Tingleff, "Methods for non-linear least squares problems", 2004,
section 3.2). A point that is rejected multiplies λ by five; that of whole flights by as much more
as a parabola through the losses says that the step was too long. Those of many short windows have
kinks, where controllers' and motors' steps pass each other, of which a parabola knows nothing.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import numpy as np
from numpy.typing import ArrayLike, NDArray

from tuner.objective.batch import sums_at
from tuner.objective.criterion import Criterion, Point, SegmentSums
from tuner.objective.normal import Objective
from tuner.search.normal_equations import NormalEquations, normal_equations

Array = NDArray[np.float64]

ACCEPTED, WELL_PREDICTED = 0.05, 0.7
"""Share of the predicted fall of the loss from which a point is accepted, and λ made smaller."""
FACTOR = 5.0
"""By which λ changes."""
STILL = 1e-9
"""Change of a coordinate, and of the loss, below which nothing moves any more; relative to one, and
to the coordinate or the loss where that is larger."""
CHEAP = 8
"""Coefficients for each free number of a start from which a flight without derivatives costs so
much less than one with them that a point is judged by it first."""
RIDGE = 1e-13
"""Added to the Hessian's diagonal, relative to its largest element: a singular one has a factor."""


class Step(NamedTuple):
    """Where the solver stands after a step; with S starts, every array has S first.

    Attributes
    ----------
    point
        The best point so far.
    tried
        The point to be tried next.
    accepted
        (S,) whether the tried point was better.
    damping
        (S,) λ of the next step, relative to the Hessian per compared value.
    still
        (S,) whether the accepted point and its loss differ from those before by next to nothing.
    predicted_reduction
        (S,) share of the loss at the best point by which its minimum would be lower, were the
        residuals linear: ½ gᵀH⁻¹g over the loss. Free of units and of damping.
    quadratic
        About the best point; None before the first step.
    best
        The segments' sums there, gradient and Hessian included.
    sums
        Those at the point that was tried.
    ahead
        Those at the point to be tried next, where that was flown already.
    """

    point: Point
    tried: Point
    accepted: NDArray[np.bool_]
    damping: Array
    still: NDArray[np.bool_]
    predicted_reduction: Array
    quadratic: NormalEquations | None = None
    best: SegmentSums | None = None
    sums: SegmentSums | None = None
    ahead: SegmentSums | None = None

    @property
    def loss(self) -> Array:
        """(S,) at the best point, per compared value."""
        if self.quadratic is None:
            return np.full(len(self.damping), np.inf)
        return np.asarray(self.quadratic.loss)


def begin(points: Point, damping: Array | None = None, sums: SegmentSums | None = None) -> Step:
    """Return where the solver stands before its first step from S points.

    Parameters
    ----------
    points
        The starts; their leaves have S first, and so has every array returned.
    damping
        (S,) λ of the first step, relative to the Hessian per compared value; 1 by default.
    sums
        The segments' at the starts, where these were flown already.
    """
    points = Point(np.asarray(points.coefficients), np.asarray(points.offsets))
    starts = len(points.coefficients)
    return Step(
        point=points,
        tried=points,
        accepted=np.ones(starts, bool),
        damping=np.ones(starts) if damping is None else np.asarray(damping, float),
        still=np.zeros(starts, bool),
        predicted_reduction=np.full(starts, np.inf),
        ahead=sums,
    )


def advance(objective: Objective, before: Step, criterion: Criterion, free: ArrayLike) -> Step:
    """Try one point for every start: keep those that are better, and propose the next.

    The points are flown here, or wherever the engine in force computes.

    Parameters
    ----------
    objective
        The problem.
    before
        What `begin` or the last call returned.
    criterion
        Horizon, scales, robust limit: change only at `begin`.
    free
        (K + offsets·N,) one for what may move, zero for what stays; changes only at `begin`.
    """
    moves = np.flatnonzero(free)
    each = [_of(before, start) for start in range(len(before.damping))]

    def quadratics(sums: SegmentSums) -> list[NormalEquations]:
        return [
            normal_equations(
                objective.space, objective.flight, one.tried, criterion, _of(sums, start)
            )
            for start, one in enumerate(each)
        ]

    sums, here = before.ahead, None
    unknown = 0 if criterion.states is None else len(criterion.states)
    if before.quadratic is not None and CHEAP * unknown <= len(objective.space):
        plain = sums_at(objective, before.tried, criterion, derivatives=False)
        found = quadratics(plain)
        if not any(_tried(one, at.loss, moves)[0] for one, at in zip(each, found, strict=True)):
            sums, here = plain, found
    if sums is None:
        sums = sums_at(objective, before.tried, criterion)
    here = here or quadratics(sums)
    longest = FACTOR if objective.segments.windowed else FACTOR**3
    steps = [
        _stepped(one, _of(sums, start), here[start], moves, longest)
        for start, one in enumerate(each)
    ]
    step: Step = jax.tree.map(lambda *leaves: np.stack(leaves), *steps)
    return step


def _stepped(
    before: Step,
    sums: SegmentSums,
    here: NormalEquations,
    moves: NDArray[np.intp],
    longest: float,
) -> Step:
    """Return what becomes of one start, given sums and quadratic at the point to be tried.

    ``longest`` is by how much a rejected step is taken to have been too long at most.
    """
    tried, last = before.tried, before.quadratic
    damping, still, accepted = float(before.damping), False, True
    if last is not None:
        change = (_packed(tried) - _packed(before.point))[moves]
        rise = here.loss - last.loss
        accepted, predicted = _tried(before, here.loss, moves)
        if not accepted:
            slope = -float(last.gradient[moves] @ change)
            too_long = 2.0 * (1.0 + rise / slope) if slope > 0.0 else FACTOR
            damping *= float(np.nan_to_num(np.clip(too_long, FACTOR, longest), nan=FACTOR))
        elif predicted < 0.0 and rise < WELL_PREDICTED * predicted:
            damping /= FACTOR
        at_rest = np.abs(change) < STILL * (1.0 + np.abs(_packed(tried)[moves]))
        still = accepted and bool(at_rest.all()) and abs(rise) < STILL * (1.0 + here.loss)
        here = here if accepted else last
    point = tried if accepted else before.point
    gradient, hessian = here.gradient[moves], here.hessian[np.ix_(moves, moves)]
    following = _packed(point)
    following[moves] -= _solved(hessian, gradient, damping)
    gain = 0.5 * gradient @ _solved(hessian, gradient, 0.0)
    return Step(
        point=point,
        tried=_unpacked(following, point),
        accepted=np.asarray(accepted),
        damping=np.asarray(damping),
        still=np.asarray(still),
        predicted_reduction=np.asarray(float(gain) / max(here.loss, 1e-300)),
        quadratic=here,
        best=sums if accepted else before.best,
        sums=sums,
    )


def _tried(before: Step, loss: float, moves: NDArray[np.intp]) -> tuple[bool, float]:
    """Return whether one start's point is accepted with a loss, and the rise that was predicted."""
    last = before.quadratic
    assert last is not None, "what was tried has a point to be better than"
    change = (_packed(before.tried) - _packed(before.point))[moves]
    predicted = last.gradient[moves] @ change
    predicted += 0.5 * change @ last.hessian[np.ix_(moves, moves)] @ change
    return bool(loss - last.loss <= ACCEPTED * predicted), float(predicted)


def _solved(hessian: Array, gradient: Array, damping: float) -> Array:
    """Return (H + λI)⁻¹ g; NaN where something in it is none."""
    if not len(gradient):
        return gradient
    ridge = RIDGE * hessian.diagonal().max()
    damped = hessian + (ridge + damping) * np.eye(len(gradient))
    try:
        factor = np.linalg.cholesky(damped)
        return np.asarray(np.linalg.solve(factor.T, np.linalg.solve(factor, gradient)))
    except np.linalg.LinAlgError:  # not positive, or not finite
        return np.full(len(gradient), np.nan)


def _of(tree: Any, start: int) -> Any:
    return jax.tree.map(lambda leaf: leaf[start], tree)


def _packed(point: Point) -> Array:
    return np.concatenate([point.coefficients, np.ravel(point.offsets)])


def _unpacked(packed: Array, like: Point) -> Point:
    count = len(like.coefficients)
    return replace(
        like, coefficients=packed[:count], offsets=packed[count:].reshape(like.offsets.shape)
    )

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

from dataclasses import dataclass, replace
from typing import Any

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


@dataclass(frozen=True)
class Step:
    """Where the solver stands after a step; with S starts, every array has S first.

    Attributes
    ----------
    point
        The best point so far.
    tried
        The point to be tried next.
    sums
        The segments' sums at the point that was tried, gradient and Hessian included; None before.
    best
        Those at the best point.
    loss
        (S,) at the best point, per compared value.
    accepted
        (S,) whether the tried point was better.
    damping
        (S,) λ of the next step, relative to the Hessian per compared value.
    still
        (S,) whether the accepted point and its loss differ from those before by next to nothing.
    predicted_reduction
        (S,) share of the loss at the best point by which its minimum would be lower, were the
        residuals linear: ½ gᵀH⁻¹g over the loss. Free of units and of damping.
    quadratics
        Of each start at its best point; empty before.
    ahead
        The segments' sums at the point to be tried next, where that was flown already.
    """

    point: Point
    tried: Point
    sums: SegmentSums | None
    best: SegmentSums | None
    loss: Array
    accepted: NDArray[np.bool_]
    damping: Array
    still: NDArray[np.bool_]
    predicted_reduction: Array
    quadratics: tuple[NormalEquations, ...] = ()
    ahead: SegmentSums | None = None


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
        sums=None,
        best=None,
        loss=np.full(starts, np.inf),
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
    flight, starts = objective.flight, range(len(before.loss))

    def quadratics(sums: SegmentSums) -> list[NormalEquations]:
        return [
            normal_equations(
                objective.space, flight, _of(before.tried, start), criterion, _of(sums, start)
            )
            for start in starts
        ]

    sums, tried = before.ahead, None
    unknown = 0 if criterion.states is None else len(criterion.states)
    if before.quadratics and CHEAP * unknown <= len(objective.space):
        plain = sums_at(objective, before.tried, criterion, derivatives=False)
        found = quadratics(plain)
        if not any(_tried(before, start, found[start].loss, moves)[0] for start in starts):
            sums, tried = plain, found
    if sums is None:
        sums = sums_at(objective, before.tried, criterion)
    tried = tried or quadratics(sums)
    longest = FACTOR if objective.segments.windowed else FACTOR**3
    steps = [_stepped(before, start, tried[start], moves, longest) for start in starts]
    accepted = np.array([step.accepted for step in steps])
    best = before.best

    def kept(new: Any, old: Any) -> Any:
        return np.where(accepted.reshape(-1, *[1] * (np.ndim(new) - 1)), new, old)

    return Step(
        point=jax.tree.map(kept, before.tried, before.point),
        tried=jax.tree.map(lambda *leaves: np.stack(leaves), *[step.tried for step in steps]),
        sums=sums,
        best=sums if best is None else jax.tree.map(kept, sums, best),
        loss=np.array([step.quadratic.loss for step in steps]),
        accepted=accepted,
        damping=np.array([step.damping for step in steps]),
        still=np.array([step.still for step in steps]),
        predicted_reduction=np.array([step.predicted_reduction for step in steps]),
        quadratics=tuple(step.quadratic for step in steps),
    )


@dataclass(frozen=True)
class _Stepped:
    """What becomes of one start."""

    accepted: bool
    still: bool
    damping: float
    quadratic: NormalEquations
    tried: Point
    predicted_reduction: float


def _stepped(
    before: Step, start: int, here: NormalEquations, moves: NDArray[np.intp], longest: float
) -> _Stepped:
    """Return what becomes of a start, given the quadratic at the point that was to be tried.

    ``longest`` is by how much a rejected step is taken to have been too long at most.
    """
    point, tried = _of(before.point, start), _of(before.tried, start)
    damping, still, accepted = float(before.damping[start]), False, True
    if before.quadratics:
        last = before.quadratics[start]
        change = (_packed(tried) - _packed(point))[moves]
        rise = here.loss - last.loss
        accepted, predicted = _tried(before, start, here.loss, moves)
        if not accepted:
            slope = -float(last.gradient[moves] @ change)
            too_long = 2.0 * (1.0 + rise / slope) if slope > 0.0 else FACTOR
            damping *= float(np.nan_to_num(np.clip(too_long, FACTOR, longest), nan=FACTOR))
        elif predicted < 0.0 and rise < WELL_PREDICTED * predicted:
            damping /= FACTOR
        at_rest = np.abs(change) < STILL * (1.0 + np.abs(_packed(tried)[moves]))
        still = accepted and bool(at_rest.all()) and abs(rise) < STILL * (1.0 + here.loss)
        here = here if accepted else last
    base = tried if accepted else point
    gradient, hessian = here.gradient[moves], here.hessian[np.ix_(moves, moves)]
    following = _packed(base)
    following[moves] -= _solved(hessian, gradient, damping)
    gain = 0.5 * gradient @ _solved(hessian, gradient, 0.0)
    return _Stepped(
        accepted,
        still,
        damping,
        here,
        _unpacked(following, base),
        float(gain) / max(here.loss, 1e-300),
    )


def _tried(before: Step, start: int, loss: float, moves: NDArray[np.intp]) -> tuple[bool, float]:
    """Return whether a start's point is accepted with a loss, and the rise that was predicted."""
    last = before.quadratics[start]
    change = (_packed(_of(before.tried, start)) - _packed(_of(before.point, start)))[moves]
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

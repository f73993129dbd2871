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

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import numpy as np
from numpy.typing import ArrayLike, NDArray

from tuner.core.numerics import Array
from tuner.objective.criterion import Criterion, Point, SegmentSums
from tuner.objective.normal_equations import (
    NEAR,
    NormalEquations,
    Objective,
    normal_equations,
    position_rmse,
    root_mean_squares,
    sums_at,
)
from tuner.search.progress import Iterate, StageProblem
from tuner.search.stages import WEIGHED

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
FAR = 5.0
"""Standard deviations beyond which no start is believed to lie."""
MOVED = 0.3
"""Standard deviations by which a start may differ from the one about which it was linearised."""
HANDED_ON = 0.01
"""Share of the loss: where a stage's normal equations predict no more, their step is not tried in
it, but in the next. With 0.05 instead, a flight of noise among good ones leads the search astray,
`examples/search_trials.py`."""
LEAST_DAMPING = 1e-6
"""λ that no stage begins below, relative to the Hessian per compared value."""
SETTLED = 0.5 * 0.1**2
"""Promised rise of the log-likelihood at which the last stage ends: a tenth of a standard error."""


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
    promised
        (S,) the same of the point to be tried next, which damping holds nearer.
    quadratic
        About the best point; None before the first step.
    best
        The segments' sums there, gradient and Hessian included.
    sums
        Those at the point that was tried last; before the first step at the starts, where these
        were flown already.
    """

    point: Point
    tried: Point
    accepted: NDArray[np.bool_]
    damping: Array
    still: NDArray[np.bool_]
    predicted_reduction: Array
    promised: Array
    quadratic: NormalEquations | None = None
    best: SegmentSums | None = None
    sums: SegmentSums | None = None

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
        promised=np.full(starts, np.inf),
        sums=sums,
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
            normal_equations(objective, one.tried, criterion, _of(sums, start))
            for start, one in enumerate(each)
        ]

    sums, here = before.sums if before.quadratic is None else None, None
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
    back = _solved(hessian, gradient, damping)
    following[moves] -= back
    gain = 0.5 * gradient @ _solved(hessian, gradient, 0.0)
    promised = gradient @ back - 0.5 * back @ hessian @ back
    return Step(
        point=point,
        tried=_unpacked(following, point),
        accepted=np.asarray(accepted),
        damping=np.asarray(damping),
        still=np.asarray(still),
        predicted_reduction=np.asarray(float(gain) / max(here.loss, 1e-300)),
        promised=np.asarray(float(promised) / max(here.loss, 1e-300)),
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


def descend(problem: StageProblem) -> Iterator[Iterate]:
    """Minimise a stage's loss, every start's; coefficients and flights' offsets move together.

    Where segments' starts are free, each point is flown from those that the best one asks for. A
    point that was linearised about others may have seemed better than it is: if none is found to be
    better still, it is flown again.
    """
    free = np.concatenate([problem.free.coefficients, problem.free.offsets.ravel()])
    # about which starts (L, F) the next point is linearised, and the best one was
    states = best_about = problem.criterion.states
    step, losses = begin(problem.points, problem.damping, problem.sums), list[Array]()
    while True:
        step = advance(problem.objective, step, replace(problem.criterion, states=states), free)
        assert step.sums is not None, "what has stepped has sums"
        assert step.best is not None, "and so has what it found"
        best, worst = int(np.argmin(step.loss)), _worst_of_most(problem.objective, step.sums)
        asked, here = starts_asked_for(step.best, best, states), _of(step.sums, best)
        found = Iterate(
            points=step.point,
            losses=step.loss,
            accepted=step.accepted,
            position_rmse=position_rmse(problem.objective, here.squares, here.counts),
            damping=float(step.damping[best]),
            sums=step.best,
            next_start=_next_stage_start(problem, step, worst),
        )
        if not step.accepted[best] and are_far(asked, best_about):
            states, best_about, losses = asked, asked, []
            step = begin(step.point, step.damping)
            yield found
            continue
        if step.accepted[best]:
            states, best_about = asked, states
        losses.append(found.losses)
        yield replace(found, converged=_has_converged(problem, step, worst, losses))


def _has_converged(
    problem: StageProblem, step: Step, worst: Array, losses: Sequence[Array]
) -> bool:
    """Return whether every start is good enough for the next stage, or gains no more.

    `Step.still` ends a start whose nine leading digits no longer change. No recording has so many,
    so that a stage's tolerance ends it sooner: as soon as the loss gains less than that, by the
    last accepted step or by the last three tries; or before that step is tried, where the normal
    equations predict no gain that matters. Tries that were rejected may have been too long: the
    last stage makes them shorter until they promise no more than that.
    """
    assert step.sums is not None, "what has stepped has sums"
    stage, predicted = problem.stage, step.predicted_reduction
    # windows that a model meets far from noise have no minimum that can be told from its valley
    vague = problem.objective.segments.windowed & (worst > NEAR)
    least = np.where(vague, max(stage.tolerance, WEIGHED), stage.tolerance)
    if stage.rough:
        little = predicted <= stage.tolerance
    elif not problem.last:
        little = (predicted <= HANDED_ON) & step.accepted & (worst <= NEAR)
    else:
        little = predicted * step.loss * step.sums.compared <= SETTLED
    ended = little | (step.loss <= stage.enough) | step.still
    if len(losses) > 1:
        ended |= step.accepted & (losses[-2] - losses[-1] <= least * np.abs(losses[-1]))
    if len(losses) > 3:
        long = problem.last & ~step.accepted & (step.promised > least)
        ended |= ~long & (losses[-4] - losses[-1] <= least * np.abs(losses[-1]))
    return bool(np.all(ended))


def _worst_of_most(objective: Objective, sums: SegmentSums) -> Array:
    """Return (S,) by how many σ the middle flight's worst channel is off."""
    channels = list(root_mean_squares(objective, sums).values())
    return np.asarray(np.median(np.nan_to_num(channels).max(axis=0), axis=-1))


def _next_stage_start(problem: StageProblem, step: Step, worst: Array) -> tuple[Point, Array]:
    """Return what a next stage begins with: the trust that was earned, if the fit is near.

    That is where most flights are met so well that the normal equations can be trusted. A model
    that lacks something is led astray by long steps: the damping that a stage begins with holds it
    where the last one ended. If the stage saw all there is to see, weights alone differ then.
    """
    near = step.accepted & (worst <= NEAR)
    untried = near & (step.predicted_reduction <= HANDED_ON)
    points: Point = jax.tree.map(
        lambda new, old: np.where(untried.reshape(-1, *[1] * (old.ndim - 1)), new, old),
        step.tried,
        step.point,
    )
    trusted = near | (problem.stage.horizon >= problem.objective.samples)
    return points, np.where(trusted, np.clip(step.damping, LEAST_DAMPING, 1.0), 1.0)


def starts_asked_for(sums: SegmentSums, best: int, before: Array | None) -> Array | None:
    """Return the segments' starts (L, F) that one of S points asks for.

    Parameters
    ----------
    sums
        At the points.
    best
        Number of the point.
    before
        (L, F) starts about which was linearised; None where they are known.
    """
    if before is None:
        return None
    asked = np.asarray(sums.states)[best]
    return np.clip(np.where(np.isfinite(asked), asked, before), -FAR, FAR)


def are_far(starts: Array | None, others: Array | None) -> bool:
    """Return whether a linear model about some starts (L, F) is not to be trusted at others."""
    if starts is None or others is None:
        return False
    return bool(np.abs(starts - others).max(initial=0.0) > MOVED)

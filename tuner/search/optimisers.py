"""The optimisers of a stage: Levenberg-Marquardt for several starts at once, and CMA-ES.

About the best point so far the loss is the quadratic of its normal equations, c + gᵀd + ½ dᵀHd. The
next point lies at d = -(H + λI)⁻¹ g. It is accepted if the gain ratio, actual over predicted fall
of the loss, exceeds 0.05; λ is divided by five where it exceeds 0.7 (Madsen, Nielsen and Tingleff,
"Methods for non-linear least squares problems", 2004, section 3.2). A rejected point multiplies λ
by five, for whole flights by more if a parabola through the losses asks for a shorter step. Losses
of many short windows have kinks, where steps of controllers and motors pass each other: there a
parabola does not hold.

CMA-ES searches where gradients lead to false minima: a population on the unit box, one batch each.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple
from warnings import catch_warnings

import jax
import numpy as np
from numpy.typing import ArrayLike, NDArray

from tuner.core.numerics import Array
from tuner.objective.criterion import Criterion, Point, SegmentSums, picked
from tuner.objective.normal_equations import (
    MATCHED_RATIO,
    VECTORS_AT_ONCE,
    NormalEquations,
    Objective,
    evaluate,
    normal_equations,
    position_rmse,
    root_mean_squares,
    sums_at,
)
from tuner.search.progress import Iterate, StageProblem
from tuner.search.stages import WINDOW_TOLERANCE

MIN_GAIN_RATIO, GOOD_GAIN_RATIO = 0.05, 0.7
"""Least gain ratio of an accepted point, and of a smaller λ."""
DAMPING_FACTOR = 5.0
STALL_TOLERANCE = 1e-9
"""Change of a coordinate or of the loss, relative to the larger of it and one, that counts as 0."""
MIN_COEFFICIENTS_PER_STATE = 8
"""Coefficients per free initial state above which a point is first simulated without derivatives:
that costs much less."""
RIDGE = 1e-13
"""Added to the Hessian's diagonal, relative to its largest element: factorises a singular one."""
MAX_STATE_SD = 5.0
"""Largest initial state, in its standard deviations."""
RELINEARISE_SD = 0.3
"""Largest change of an initial state, in standard deviations, without a new linearisation."""
HANDOVER_REDUCTION = 0.01
"""Predicted relative reduction of the loss below which a stage leaves the step to the next one.
With 0.05 a flight of noise among good ones leads the search astray, `examples/search_trials.py`."""
MIN_DAMPING = 1e-6
"""Least λ of a stage's first step, relative to the Hessian per compared value."""
FINAL_LIKELIHOOD_GAIN = 0.5 * 0.1**2
"""Predicted rise of the log-likelihood that ends the last stage: a tenth of a standard error."""


class Step(NamedTuple):
    """The state of the solver after a step; with S starts, every array has S first.

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
    stalled
        (S,) whether the accepted point and its loss are those before, to `STALL_TOLERANCE`.
    predicted_reduction
        (S,) relative reduction of the loss to the minimum of its quadratic: ½ gᵀH⁻¹g over the loss.
        Independent of units and damping.
    step_reduction
        (S,) the same for the damped step to the point to be tried next.
    quadratic
        About the best point; None before the first step.
    best
        The segments' sums there, gradient and Hessian included.
    sums
        Those at the point that was tried last; before the first step at the starts, if known.
    """

    point: Point
    tried: Point
    accepted: NDArray[np.bool_]
    damping: Array
    stalled: NDArray[np.bool_]
    predicted_reduction: Array
    step_reduction: Array
    quadratic: NormalEquations | None = None
    best: SegmentSums | None = None
    sums: SegmentSums | None = None

    @property
    def loss(self) -> Array:
        """(S,) at the best point, per compared value."""
        if self.quadratic is None:
            return np.full(len(self.damping), np.inf)
        return np.asarray(self.quadratic.loss)


def initial_step(
    points: Point, damping: Array | None = None, sums: SegmentSums | None = None
) -> Step:
    """Return the state of the solver before its first step from S points.

    Parameters
    ----------
    points
        The starts; their leaves have S first, and so has every array returned.
    damping
        (S,) λ of the first step, relative to the Hessian per compared value; 1 by default.
    sums
        The segments' sums at the starts, if known.
    """
    points = Point(np.asarray(points.coefficients), np.asarray(points.offsets))
    starts = len(points.coefficients)
    return Step(
        point=points,
        tried=points,
        accepted=np.ones(starts, bool),
        damping=np.ones(starts) if damping is None else np.asarray(damping, float),
        stalled=np.zeros(starts, bool),
        predicted_reduction=np.full(starts, np.inf),
        step_reduction=np.full(starts, np.inf),
        sums=sums,
    )


def advance(objective: Objective, before: Step, criterion: Criterion, free: ArrayLike) -> Step:
    """Try one point for every start: keep those that are better, and propose the next.

    The engine in force simulates the points.

    Parameters
    ----------
    objective
        The problem.
    before
        The result of `initial_step` or of the last call.
    criterion
        Horizon, scales, robust limit: change only at `initial_step`.
    free
        (K + offsets·N,) one for free parameters, zero for others; changes only at `initial_step`.
    """
    moves = np.flatnonzero(free)
    still = not np.any(moves < len(objective.space))
    each = [picked(before, start) for start in range(len(before.damping))]

    def quadratics(sums: SegmentSums) -> list[NormalEquations]:
        return [
            normal_equations(objective, one.tried, criterion, picked(sums, start))
            for start, one in enumerate(each)
        ]

    sums, here = before.sums if before.quadratic is None else None, None
    unknown = 0 if criterion.states is None else len(criterion.states)
    if before.quadratic is not None and MIN_COEFFICIENTS_PER_STATE * unknown <= len(
        objective.space
    ):
        plain = sums_at(objective, before.tried, criterion, derivatives=False)
        tried = quadratics(plain)
        if not any(_accepts(one, at.loss, moves)[0] for one, at in zip(each, tried, strict=True)):
            sums, here = plain, tried
    if sums is None:
        sums = sums_at(objective, before.tried, criterion, still=still)
    here = here or quadratics(sums)
    longest = DAMPING_FACTOR if objective.segments.windowed else DAMPING_FACTOR**3
    steps = [
        _stepped(one, picked(sums, start), here[start], moves, longest)
        for start, one in enumerate(each)
    ]
    step: Step = jax.tree.map(lambda *leaves: np.stack(leaves), *steps)
    return step


def _stepped(
    before: Step, sums: SegmentSums, here: NormalEquations, moves: NDArray[np.intp], longest: float
) -> Step:
    """Return the step of one start, given sums and quadratic at the point to be tried.

    ``longest`` is the largest factor on λ after a rejected step.
    """
    tried, last = before.tried, before.quadratic
    damping, stalled, accepted = float(before.damping), False, True
    if last is not None:
        change = (tried.packed - before.point.packed)[moves]
        rise = here.loss - last.loss
        accepted, predicted = _accepts(before, here.loss, moves)
        if not accepted:
            slope = -float(last.gradient[moves] @ change)
            too_long = 2.0 * (1.0 + rise / slope) if slope > 0.0 else DAMPING_FACTOR
            damping *= float(
                np.nan_to_num(np.clip(too_long, DAMPING_FACTOR, longest), nan=DAMPING_FACTOR)
            )
        elif predicted < 0.0 and rise < GOOD_GAIN_RATIO * predicted:
            damping /= DAMPING_FACTOR
        at_rest = np.abs(change) < STALL_TOLERANCE * (1.0 + np.abs(tried.packed[moves]))
        stalled = (
            accepted and bool(at_rest.all()) and abs(rise) < STALL_TOLERANCE * (1.0 + here.loss)
        )
        here = here if accepted else last
    point = tried if accepted else before.point
    gradient, hessian = here.gradient[moves], here.hessian[np.ix_(moves, moves)]
    back, onward = _solved(hessian, gradient, damping), np.zeros(len(here.gradient))
    onward[moves] = -back
    gain = 0.5 * gradient @ _solved(hessian, gradient, 0.0)
    step_reduction = gradient @ back - 0.5 * back @ hessian @ back
    return Step(
        point=point,
        tried=point.after(onward),
        accepted=np.asarray(accepted),
        damping=np.asarray(damping),
        stalled=np.asarray(stalled),
        predicted_reduction=np.asarray(float(gain) / max(here.loss, 1e-300)),
        step_reduction=np.asarray(float(step_reduction) / max(here.loss, 1e-300)),
        quadratic=here,
        best=sums if accepted else before.best,
        sums=sums,
    )


def _accepts(before: Step, loss: float, moves: NDArray[np.intp]) -> tuple[bool, float]:
    """Return whether one start's point is accepted with a loss, and the predicted rise."""
    last = before.quadratic
    assert last is not None, "a point that was tried follows an accepted one"
    change = (before.tried.packed - before.point.packed)[moves]
    predicted = last.gradient[moves] @ change
    predicted += 0.5 * change @ last.hessian[np.ix_(moves, moves)] @ change
    return bool(loss - last.loss <= MIN_GAIN_RATIO * predicted), float(predicted)


def _solved(hessian: Array, gradient: Array, damping: float) -> Array:
    """Return (H + λI)⁻¹ g; NaN where that fails."""
    if not len(gradient):
        return gradient
    ridge = RIDGE * hessian.diagonal().max()
    damped = hessian + (ridge + damping) * np.eye(len(gradient))
    try:
        factor = np.linalg.cholesky(damped)
        return np.asarray(np.linalg.solve(factor.T, np.linalg.solve(factor, gradient)))
    except np.linalg.LinAlgError:  # not positive, or not finite
        return np.full(len(gradient), np.nan)


def descend(problem: StageProblem) -> Iterator[Iterate]:
    """Minimise a stage's loss for every start; coefficients and flights' offsets move together.

    Free initial states are those estimated at the best point. A point linearised about others may
    have seemed better than it is: if the next step is rejected, it is simulated again.
    """
    # initial states (L, F) of the next linearisation, and of the best point's
    states = best_about = problem.criterion.states
    step, losses = initial_step(problem.points, problem.damping, problem.sums), list[Array]()
    while True:
        step = advance(
            problem.objective, step, replace(problem.criterion, states=states), problem.free.packed
        )
        assert step.sums is not None, "a step has sums"
        assert step.best is not None, "and a best point"
        best, channels = int(np.argmin(step.loss)), root_mean_squares(problem.objective, step.sums)
        # (S,) the median over flights of the worst channel's RMS, in σ
        worst = np.median(np.nan_to_num(list(channels.values())).max(axis=0), axis=-1)
        estimated, here = estimated_states(step.best, best, states), picked(step.sums, best)
        iterate = Iterate(
            points=step.point,
            losses=step.loss,
            accepted=step.accepted,
            position_rmse=position_rmse(problem.objective, here.squares, here.counts),
            damping=float(step.damping[best]),
            sums=step.best,
            next_start=_next_stage_start(problem, step, worst),
        )
        if not step.accepted[best] and need_relinearising(estimated, best_about):
            states, best_about, losses = estimated, estimated, []
            step = initial_step(step.point, step.damping)
            yield iterate
            continue
        if step.accepted[best]:
            states, best_about = estimated, states
        losses.append(iterate.losses)
        yield replace(iterate, converged=_has_converged(problem, step, worst, losses))


def _has_converged(
    problem: StageProblem, step: Step, worst: Array, losses: Sequence[Array]
) -> bool:
    """Return whether every start is good enough for the next stage, or gains no more.

    A stage's tolerance ends it when the last accepted step or the last three tries gain less, or
    when the normal equations predict less. Rejected steps may have been too long: the last stage
    shortens them until their predicted gain is below the tolerance. `Step.stalled` ends the rest.
    """
    assert step.sums is not None, "a step has sums"
    stage, predicted = problem.stage, step.predicted_reduction
    # windows with residuals far above the noise have no sharp minimum
    vague = problem.objective.segments.windowed & (worst > MATCHED_RATIO)
    least = np.where(vague, max(stage.tolerance, WINDOW_TOLERANCE), stage.tolerance)
    least = np.where(worst > MATCHED_RATIO, np.maximum(least, stage.far_off_tolerance), least)
    if stage.rough:
        little = predicted <= stage.tolerance
    elif not problem.last:
        little = (predicted <= HANDOVER_REDUCTION) & step.accepted & (worst <= MATCHED_RATIO)
    else:
        little = predicted * step.loss * step.sums.compared <= FINAL_LIKELIHOOD_GAIN
    ended = little | (step.loss <= stage.target_loss) | step.stalled
    if len(losses) > 1:
        ended |= step.accepted & (losses[-2] - losses[-1] <= least * np.abs(losses[-1]))
    if len(losses) > 3:
        long = problem.last & ~step.accepted & (step.step_reduction > least)
        ended |= ~long & (losses[-4] - losses[-1] <= least * np.abs(losses[-1]))
    return bool(np.all(ended))


def _next_stage_start(problem: StageProblem, step: Step, worst: Array) -> tuple[Point, Array]:
    """Return points and damping of the next stage: those of this one, if the fit is near.

    That is where most flights are matched so well that the normal equations hold. Long steps would
    lead a model with missing terms astray: the default damping keeps it close. After a stage of
    whole flights the next one differs by its weights alone.
    """
    near = step.accepted & (worst <= MATCHED_RATIO)
    untried = near & (step.predicted_reduction <= HANDOVER_REDUCTION)
    points: Point = jax.tree.map(
        lambda new, old: np.where(untried.reshape(-1, *[1] * (old.ndim - 1)), new, old),
        step.tried,
        step.point,
    )
    trusted = near | (problem.stage.horizon >= problem.objective.samples)
    return points, np.where(trusted, np.clip(step.damping, MIN_DAMPING, 1.0), 1.0)


def estimated_states(sums: SegmentSums, best: int, before: Array | None) -> Array | None:
    """Return the segments' initial states (L, F) estimated at one of S points.

    Parameters
    ----------
    sums
        At the points.
    best
        Number of the point.
    before
        (L, F) states of the linearisation; None where they are not free.
    """
    if before is None:
        return None
    estimated = np.asarray(sums.states)[best]
    return np.clip(np.where(np.isfinite(estimated), estimated, before), -MAX_STATE_SD, MAX_STATE_SD)


def need_relinearising(starts: Array | None, others: Array | None) -> bool:
    """Return whether initial states (L, F) are too far apart for a linear model about one."""
    if starts is None or others is None:
        return False
    return bool(np.abs(starts - others).max(initial=0.0) > RELINEARISE_SD)


POPULATION = VECTORS_AT_ONCE
"""Vectors in one generation: those that are simulated at once."""
INITIAL_SD = 0.5
"""First standard deviation, in those of the coefficients' priors."""
MAX_INITIAL_SD = 0.25
"""Largest first standard deviation, as a share of the coefficient's range."""
LOSS_TOLERANCE = 1e-3
"""Relative difference of the last generations' best losses at which a stage ends."""


def evolve(problem: StageProblem) -> Iterator[Iterate]:
    """Minimise a stage's loss by pycma from the best start; the flights' offsets stay as they are.

    The population is as wide as the coefficients' priors. Its best vector replaces the start.
    """
    import cma  # noqa: PLC0415 (takes its time)

    space, start = problem.objective.space, problem.best
    point = picked(problem.points, start)
    moves = np.flatnonzero(problem.free.coefficients)
    sums = problem.objective.sums(point, problem.criterion, derivatives=False)
    coefficients, losses = np.array(problem.points.coefficients), np.array(problem.losses)
    losses[start] = np.inf
    options = {
        "bounds": [0.0, 1.0],
        "CMA_stds": np.minimum(INITIAL_SD * (space.prior_sd / space.width)[moves], MAX_INITIAL_SD),
        "seed": problem.seed,
        "popsize": POPULATION,
        "maxiter": problem.stage.steps,
        "tolfunrel": LOSS_TOLERANCE,
        "verbose": -9,
    }
    share = space.share(point.coefficients)
    with catch_warnings(action="ignore"):
        strategy = cma.CMAEvolutionStrategy(share[moves], 1.0, options)
    while True:
        with catch_warnings(action="ignore"):
            drawn = strategy.ask()
            shares = np.repeat(share[None], len(drawn), axis=0)
            shares[:, moves] = drawn
            vectors = space.at_share(shares)
            batch = evaluate(problem.objective, vectors, point, problem.criterion)
            pull = problem.criterion.prior * space.prior_residuals(vectors)
            total = batch.loss.sum(axis=-1) + 0.5 * (pull**2).sum(axis=-1)
            tried = np.nan_to_num(total / max(sums.compared, 1.0), nan=np.inf, posinf=np.inf)
            strategy.tell(drawn, list(tried))
            reasons = strategy.stop()
        best = int(np.argmin(tried))
        if tried[best] < losses[start]:
            coefficients[start], losses[start] = vectors[best], tried[best]
        yield Iterate(
            points=Point(coefficients.copy(), problem.points.offsets),
            losses=losses.copy(),
            accepted=np.ones(len(losses), bool),
            position_rmse=position_rmse(
                problem.objective, {n: s[best] for n, s in batch.squares.items()}, sums.counts
            ),
            converged=bool(reasons) and "maxiter" not in reasons,
        )

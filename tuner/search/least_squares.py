"""Nonlinear least squares for all starts at once: the optimiser of nearly every stage."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import cast

import jax
import numpy as np
from jax import Array
from numpy.typing import NDArray

from tuner.objective.criterion import Point, SegmentSums
from tuner.objective.normal import Objective
from tuner.search.levenberg_marquardt import Step, advance, begin
from tuner.search.normal_equations import NEAR, root_mean_squares
from tuner.search.optimiser import Iterate, Optimiser, StageProblem
from tuner.search.stages import WEIGHED

FAR = 5.0
"""Standard deviations beyond which no start is believed to lie."""
MOVED = 0.3
"""Standard deviations by which a start may differ from the one about which it was linearised."""


def starts_asked_for(
    sums: SegmentSums | None, best: int, before: NDArray[np.float64] | None
) -> NDArray[np.float64] | None:
    """Return the segments' starts (L, F) that one of S points asks for.

    Parameters
    ----------
    sums
        At the points; None where they were not computed.
    best
        Number of the point.
    before
        (L, F) starts about which was linearised; None where they are known.
    """
    if before is None or sums is None or sums.states is None:
        return before
    asked = np.asarray(sums.states[best])
    return np.clip(np.where(np.isfinite(asked), asked, before), -FAR, FAR)


def are_far(starts: NDArray[np.float64] | None, reference: NDArray[np.float64] | None) -> bool:
    """Return whether a linear model about some starts (L, F) is not to be trusted at others."""
    if starts is None or reference is None:
        return False
    return bool(np.abs(starts - reference).max(initial=0.0) > MOVED)


HANDED_ON = 0.01
"""Share of the loss: where a stage's normal equations predict no more, their step is not tried in
it, but in the next. With 0.05 instead, a flight of noise among good ones leads the search astray,
`examples/search_trials.py`."""
LEAST_DAMPING = 1e-6
"""λ that no stage begins below, relative to the Hessian per compared value."""
SETTLED = 0.5 * 0.1**2
"""Promised rise of the log-likelihood at which the last stage ends: a tenth of a standard error."""


@dataclass(frozen=True)
class Descent:
    """A stage under way.

    Attributes
    ----------
    step
        Where the solver stands.
    states
        (L, F) starts of the segments about which the next point is linearised: those that the best
        point asks for. None where they are known.
    reference
        (L, F) those about which the best point was.
    losses
        The losses (S,) after each step so far.
    """

    step: Step
    states: NDArray[np.float64] | None
    reference: NDArray[np.float64] | None
    losses: tuple[NDArray[np.float64], ...] = ()


class LeastSquares(Optimiser):
    """Levenberg-Marquardt; coefficients and flights' offsets move together."""

    name = "gradient"

    def init(self, problem: StageProblem) -> Descent:
        """Return the solver before its first step from the stage's points."""
        given = problem.criterion.states
        states = None if given is None else np.asarray(given)
        return Descent(begin(problem.points, problem.damping, problem.sums), states, states)

    def step(self, problem: StageProblem, state: Descent) -> tuple[Descent, Iterate]:
        """Fly every start's next point with derivatives; keep those that are better.

        Where segments' starts are free, each point is flown from those that the best one asks for.
        A point that was linearised about others may have seemed better than it is: if none is found
        to be better still, it is flown again.
        """
        free = np.concatenate([problem.free.coefficients, problem.free.offsets.ravel()])
        criterion = replace(problem.criterion, states=cast(Array | None, state.states))
        step = advance(problem.objective, state.step, criterion, free.astype(float))
        losses = np.asarray(step.loss)
        best = int(np.argmin(losses))
        iterate = Iterate(
            points=step.point,
            losses=losses,
            accepted=np.asarray(step.accepted),
            position_rmse=_position_rmse(problem.objective, step, best),
            damping=float(step.damping[best]),
            sums=step.best,
            next_start=_next_stage_start(problem, step),
        )
        states = starts_asked_for(step.best, best, state.states)
        if step.accepted[best]:
            return Descent(step, states, state.states, (*state.losses, losses)), iterate
        if are_far(states, state.reference):
            return Descent(begin(step.point, np.asarray(step.damping)), states, states), iterate
        return replace(state, step=step, losses=(*state.losses, losses)), iterate

    def terminate(self, problem: StageProblem, state: Descent) -> bool:
        """Return whether every start is good enough for the next stage, or gains no more.

        `Step.still` ends a start whose nine leading digits no longer change. No recording has so
        many, so that a stage's tolerance ends it sooner: as soon as the loss gains less than that,
        by the last accepted step or by the last three tries; or before that step is tried, where
        the normal equations predict no gain that matters.
        """
        if not state.losses:
            return False
        tolerance, last = self._tolerance(problem, state.step), state.losses[-1]
        ended = (last <= problem.stage.enough) | np.asarray(state.step.still)
        ended |= _predicts_little(problem, state.step)
        if len(state.losses) == 1:
            return bool(np.all(ended))
        accepted = np.asarray(state.step.accepted)
        by_last_step = accepted & _gains_little(state.losses[-2:], tolerance)
        by_three_tries = len(state.losses) > 3 and _gains_little(state.losses[-4:], tolerance)
        return bool(np.all(by_last_step | by_three_tries | ended))

    @staticmethod
    def _tolerance(problem: StageProblem, step: Step) -> NDArray[np.float64]:
        """Return (S,) the share of the loss that a step has to gain for another one.

        Windows that a model meets far from noise have no minimum that can be told from its valley.
        """
        vague = problem.objective.segments.windowed & (_worst_of_most(problem, step) > NEAR)
        return np.where(vague, max(problem.stage.tolerance, WEIGHED), problem.stage.tolerance)


def _gains_little(
    losses: Sequence[NDArray[np.float64]], tolerance: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Return (S,) whether the loss fell by no more than a share of itself."""
    first, *_, last = losses
    return np.asarray(first - last <= tolerance * np.abs(last))


def _predicts_little(problem: StageProblem, step: Step) -> NDArray[np.bool_]:
    """Return (S,) whether no step from the best points is worth to be tried in this stage."""
    predicted = np.asarray(step.predicted_reduction)
    if problem.stage.rough:
        return np.asarray(predicted <= problem.stage.tolerance)
    if not problem.last:
        return np.asarray((predicted <= HANDED_ON) & _is_near(problem, step))
    assert step.sums is not None, "what has stepped has sums"
    compared = sum(np.sum(np.asarray(n), axis=-1) for n in step.sums.counts.values())
    return np.asarray(predicted * np.asarray(step.loss) * compared <= SETTLED)


def _is_near(problem: StageProblem, step: Step) -> NDArray[np.bool_]:
    """Return (S,) whether most flights are met so well that the normal equations can be trusted.

    A model that lacks something is led astray by long steps: the damping that a stage begins with
    holds it where the last one ended.
    """
    return np.asarray(np.asarray(step.accepted) & (_worst_of_most(problem, step) <= NEAR))


def _worst_of_most(problem: StageProblem, step: Step) -> NDArray[np.float64]:
    """Return (S,) by how many σ the middle flight's worst channel is off."""
    assert step.sums is not None, "what has stepped has sums"
    channels = list(root_mean_squares(problem.objective, step.sums).values())
    return np.asarray(np.median(np.nan_to_num(channels).max(axis=0), axis=-1))


def _next_stage_start(problem: StageProblem, step: Step) -> tuple[Point, NDArray[np.float64]]:
    """Return what a next stage begins with: the trust that was earned, if the fit is near.

    Or if it sees no further: weights alone differ then.
    """
    near = _is_near(problem, step)
    untried = np.asarray(near & (step.predicted_reduction <= HANDED_ON))
    points: Point = jax.tree.map(
        lambda new, old: np.where(untried.reshape(-1, *[1] * (old.ndim - 1)), new, old),
        step.tried,
        step.point,
    )
    trusted = near | (problem.stage.horizon >= problem.objective.samples)
    damping = np.where(trusted, np.clip(step.damping, LEAST_DAMPING, 1.0), 1.0)
    return points, damping


def _position_rmse(objective: Objective, step: Step, start: int) -> float:
    """Return the position RMSE in m at the point that a start tried last; NaN without positions."""
    if step.sums is None or "position" not in objective.segments.measured:
        return float("nan")
    weight = np.asarray(objective.segments.measured["position"].weight)
    sigma = 1.0 / weight.max(initial=1e-30)
    counts = float(np.sum(step.sums.counts["position"][start]))
    squares = float(np.sum(step.sums.squares["position"][start]))
    return float(sigma * np.sqrt(3.0 * squares / (counts or np.nan)))

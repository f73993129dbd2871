"""Nonlinear least squares for all starts at once: the optimiser of nearly every stage."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from tuner.objective.normal import Objective
from tuner.search.levenberg_marquardt import Step, advance, begin, on_host
from tuner.search.optimiser import Iterate, Optimiser, StageProblem


@dataclass(frozen=True)
class Descent:
    """A stage under way.

    Attributes
    ----------
    step
        Where the solver stands.
    losses
        The losses (S,) after each step so far.
    """

    step: Step
    losses: tuple[NDArray[np.float64], ...] = ()


class LeastSquares(Optimiser):
    """Levenberg-Marquardt by optimistix; coefficients and flights' offsets move together."""

    name = "gradient"

    def init(self, problem: StageProblem) -> Descent:
        """Return the solver before its first step from the stage's points."""
        return Descent(begin(on_host(problem.points)))

    def step(self, problem: StageProblem, state: Descent) -> tuple[Descent, Iterate]:
        """Fly every start's next point with derivatives; keep those that are better."""
        free = np.concatenate([problem.free.coefficients, problem.free.offsets.ravel()])
        step = advance(problem.objective, state.step, problem.criterion, free.astype(float))
        losses = np.asarray(step.loss)
        best = int(np.argmin(losses))
        iterate = Iterate(
            points=step.point,
            losses=losses,
            accepted=np.asarray(step.accepted),
            position_rmse=_position_rmse(problem.objective, step, best),
            damping=float(step.damping[best]),
            sums=step.sums,
        )
        return Descent(step, (*state.losses, losses)), iterate

    def terminate(self, problem: StageProblem, state: Descent) -> bool:
        """Return whether every start is good enough for the next stage, or gains no more.

        optimistix's own rule, `Step.still`, ends a start whose nine leading digits no longer
        change. No recording has so many, so that a stage's tolerance ends it sooner: as soon as the
        loss gains less than that, by the last accepted step or by the last three tries.
        """
        if not state.losses:
            return False
        tolerance, last = problem.stage.tolerance, state.losses[-1]
        ended = (last <= problem.stage.enough) | np.asarray(state.step.still)
        if len(state.losses) == 1:
            return bool(np.all(ended))
        accepted = np.asarray(state.step.accepted)
        by_last_step = accepted & _gains_little(state.losses[-2:], tolerance)
        by_three_tries = len(state.losses) > 3 and _gains_little(state.losses[-4:], tolerance)
        return bool(np.all(by_last_step | by_three_tries | ended))


def _gains_little(losses: Sequence[NDArray[np.float64]], tolerance: float) -> NDArray[np.bool_]:
    """Return (S,) whether the loss fell by no more than a share of itself."""
    first, *_, last = losses
    return np.asarray(first - last <= tolerance * np.abs(last))


def _position_rmse(objective: Objective, step: Step, start: int) -> float:
    """Return the position RMSE in m at the point that a start tried last; NaN without positions."""
    if step.sums is None or "position" not in objective.segments.measured:
        return float("nan")
    weight = np.asarray(objective.segments.measured["position"].weight)
    sigma = 1.0 / weight.max(initial=1e-30)
    counts = float(jnp.sum(step.sums.counts["position"][start]))
    squares = float(jnp.sum(step.sums.squares["position"][start]))
    return float(sigma * np.sqrt(3.0 * squares / (counts or np.nan)))

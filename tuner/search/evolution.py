"""CMA-ES for when the slope misleads: a population on the unit box, flown as one batch."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tuner.objective.batch import CHUNK, evaluate
from tuner.objective.criterion import Criterion, Point
from tuner.objective.normal import Objective
from tuner.search.optimiser import Iterate, Optimiser, StageProblem
from tuner.search.progress import point_of

POPULATION = CHUNK
"""Vectors in one generation."""
SPREAD = 0.5
"""First standard deviation, in those of the coefficients' priors."""
WIDEST = 0.25
"""First standard deviation at most, as a share of the coefficient's range."""
FLAT = 1e-3
"""A stage ends when the best losses of the last generations differ by less than this share."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Evolution:
    """A population under way.

    Attributes
    ----------
    strategy
        cma's own state, which it changes in place.
    loss
        (n, K) vectors -> (n,) losses and position RMSE in m.
    vector, least
        The best vector (K,) so far, and its loss.
    """

    strategy: Any
    loss: Callable[[Array], tuple[Array, Array]]
    vector: Array
    least: float = np.inf


class CmaEs(Optimiser):
    """CMA-ES from the best start so far, by pycma; the flights' offsets stay where they are."""

    name = "cma"

    def init(self, problem: StageProblem) -> Evolution:
        """Return a population around the best start, as wide as its coefficients' priors."""
        import cma  # noqa: PLC0415 (takes its time)

        point, space = point_of(problem.points, problem.best), problem.objective.space
        centre, moves = np.asarray(point.coefficients), _moves(problem)
        spread = SPREAD * (space.prior_sd / space.width)[moves]
        options = {
            "bounds": [0.0, 1.0],
            "CMA_stds": np.minimum(spread, WIDEST),
            "seed": problem.seed,
            "popsize": POPULATION,
            "maxiter": problem.stage.steps,
            "tolfunrel": FLAT,
            "verbose": -9,
        }
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            strategy = cma.CMAEvolutionStrategy(space.share(centre)[moves], 1.0, options)
        return Evolution(strategy, _loss(problem.objective, point, problem.criterion), centre)

    def step(self, problem: StageProblem, state: Evolution) -> tuple[Evolution, Iterate]:
        """Fly one generation; the best vector takes the place of the start that it came from."""
        space, start = problem.objective.space, problem.best
        centre = np.asarray(problem.points.coefficients[start])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            drawn = state.strategy.ask()
            shares = np.repeat(space.share(centre)[None], len(drawn), axis=0)
            shares[:, _moves(problem)] = drawn
            vectors = space.at_share(shares)
            losses, position_rmse = state.loss(vectors)
            state.strategy.tell(drawn, list(losses))
        best = int(np.argmin(losses))
        if losses[best] < state.least:
            state = replace(state, vector=vectors[best], least=float(losses[best]))
        coefficients = np.array(problem.points.coefficients)
        coefficients[start] = state.vector
        kept = np.array(problem.losses)
        kept[start] = state.least
        iterate = Iterate(
            points=Point(np.asarray(coefficients), problem.points.offsets),
            losses=kept,
            accepted=np.ones(len(kept), bool),
            position_rmse=float(position_rmse[best]),
        )
        return state, iterate

    def terminate(self, problem: StageProblem, state: Evolution) -> bool:  # noqa: ARG002
        """Return whether pycma has a reason to stop other than the number of generations."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            reasons = state.strategy.stop()
        return bool(reasons) and "maxiter" not in reasons


def _moves(problem: StageProblem) -> NDArray[np.intp]:
    return np.flatnonzero(problem.free.coefficients)


def _loss(
    objective: Objective, point: Point, criterion: Criterion
) -> Callable[[Array], tuple[Array, Array]]:
    """Return (n, K) vectors -> (n,) losses as least squares counts them, and position RMSE in m."""
    space = objective.space
    counts = objective.sums(point, criterion).counts
    compared = max(float(sum(np.sum(number) for number in counts.values())), 1.0)
    position = objective.segments.measured.get("position")
    sigma = np.nan if position is None else 1.0 / np.asarray(position.weight).max()

    def loss(vectors: Array) -> tuple[Array, Array]:
        batch = evaluate(objective, vectors, point, criterion)
        scaled = space.scaled(vectors)
        pull = (scaled - space.prior_mean) / space.prior_sd * float(criterion.prior)
        total = np.asarray(batch.loss).sum(axis=-1) + 0.5 * (pull**2).sum(axis=-1)
        joint_pull = (scaled @ space.joint_rows.T + space.joint_offset) * float(criterion.prior)
        total = total + 0.5 * (joint_pull**2).sum(axis=-1)
        squares = np.asarray(batch.squares.get("position", np.full((len(vectors), 1, 1), np.nan)))
        placed = float(np.sum(counts.get("position", np.nan))) or np.nan
        rmse = sigma * np.sqrt(3.0 * squares.sum(axis=(1, 2)) / placed)
        return np.nan_to_num(total / compared, nan=np.inf, posinf=np.inf), rmse

    return loss

"""CMA-ES for when the slope misleads: a population on the unit box, flown as one batch."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from tuner.objective.batch import CHUNK, evaluate
from tuner.objective.criterion import Criterion, Point
from tuner.objective.normal import Objective
from tuner.search.fitted import Iteration
from tuner.search.progress import Free, Progress, criterion_of, point_of, with_feedback
from tuner.search.stages import Stage

POPULATION = CHUNK
"""Vectors in one generation."""
SPREAD = 0.5
"""First standard deviation, in those of the coefficients' priors."""
FLAT = 1e-3
"""A stage ends when the best losses of the last generations differ by less than this share."""


def evolve(
    objective: Objective,
    stage: Stage,
    progress: Progress,
    *,
    free: Free,
    seed: int,
    tell: Callable[[Progress], None],
) -> Progress:
    """Run one stage from the best start so far; clock offsets stay where they are.

    Parameters
    ----------
    objective, stage, progress
        As for `tuner.search.continuation.run_leg`.
    free
        What may move.
    seed
        Of the population; each stage draws its own.
    tell
        Called after every generation.

    Returns
    -------
    Progress
        The best vector in the place of the start that it came from.
    """
    import cma  # noqa: PLC0415 (takes its time)

    objective = with_feedback(objective, progress.feedback)
    best = int(np.argmin(progress.losses))
    point = point_of(progress.points, best)
    criterion = criterion_of(stage, progress.scales, np.asarray(point.offsets), progress.states)
    space, centre = objective.space, np.asarray(point.coefficients)
    loss_of = _loss(objective, point, criterion)
    moves = np.flatnonzero(free.coefficients)
    spread = SPREAD * (space.prior_sd / space.width)[moves]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        strategy = cma.CMAEvolutionStrategy(
            space.share(centre)[moves],
            1.0,
            {
                "bounds": [0.0, 1.0],
                "CMA_stds": np.minimum(spread, 0.25),
                "seed": 1 + seed + 1000 * progress.stage,
                "popsize": POPULATION,
                "maxiter": stage.steps,
                "tolfunrel": FLAT,
                "verbose": -9,
            },
        )
        vector, least = centre, np.inf
        while not strategy.stop():
            shares = strategy.ask()
            every = np.repeat(space.share(centre)[None], len(shares), axis=0)
            every[:, moves] = shares
            vectors = np.stack([space.at_share(share) for share in every])
            losses, position_rmse = loss_of(vectors)
            strategy.tell(shares, list(losses))
            here = int(np.argmin(losses))
            if losses[here] < least:
                vector, least = vectors[here], float(losses[here])
            progress = _told(objective, stage, progress, least, float(position_rmse[here]))
            progress = _placed(progress, best, vector, least)
            tell(progress)
    return replace(
        progress,
        stage=progress.stage + 1,
        converged="maxiter" not in strategy.stop(),
    )


def _loss(
    objective: Objective, point: Point, criterion: Criterion
) -> Callable[[NDArray[np.float64]], tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Return (S, K) vectors -> (S,) losses as least squares counts them, and position RMSE in m."""
    space = objective.space
    counts = objective.sums(point, criterion).counts
    compared = max(float(sum(np.sum(number) for number in counts.values())), 1.0)
    position = objective.segments.measured.get("position")
    sigma = np.nan if position is None else 1.0 / np.asarray(position.weight).max()

    def loss(vectors: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        batch = evaluate(objective, vectors, point, criterion)
        scaled = np.stack([np.asarray(space.scaled(jnp.asarray(vector))) for vector in vectors])
        pull = (scaled - space.prior_mean) / space.prior_sd * float(criterion.prior)
        total = np.asarray(batch.loss).sum(axis=-1) + 0.5 * (pull**2).sum(axis=-1)
        squares = np.asarray(batch.squares.get("position", np.full((len(vectors), 1, 1), np.nan)))
        placed = np.sum(counts.get("position", np.ones(1)))
        rmse = sigma * np.sqrt(3.0 * squares.sum(axis=(1, 2)) / max(float(placed), 1.0))
        return np.nan_to_num(total / compared, nan=np.inf, posinf=np.inf), rmse

    return loss


def _told(
    objective: Objective, stage: Stage, progress: Progress, loss: float, position_rmse: float
) -> Progress:
    iteration = Iteration(
        stage=stage.name,
        number=len(progress.iterations),
        loss=loss,
        position_rmse=position_rmse,
        accepted=True,
        horizon=stage.horizon / float(objective.schedule.log_rate),
    )
    return replace(
        progress,
        iterations=(*progress.iterations, iteration),
        evaluations=progress.evaluations + 1,
    )


def _placed(progress: Progress, start: int, vector: NDArray[np.float64], loss: float) -> Progress:
    coefficients = np.array(progress.points.coefficients)
    coefficients[start] = vector
    losses = np.array(progress.losses)
    losses[start] = loss
    points = Point(jnp.asarray(coefficients), progress.points.offsets)
    return replace(progress, points=points, losses=losses)

"""CMA-ES, where gradients lead to false minima: a population on the unit box, one batch each."""

from __future__ import annotations

from collections.abc import Iterator
from warnings import catch_warnings

import numpy as np

from tuner.objective.criterion import Point
from tuner.objective.normal_equations import VECTORS_AT_ONCE, evaluate, position_rmse
from tuner.search.progress import Iterate, StageProblem, point_of

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
    point = point_of(problem.points, start)
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

"""Where a search stands: all that is needed to go on, and what the solver needs to know of it."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import numpy as np
from numpy.typing import NDArray

from tuner.objective.criterion import OFFSET_UNIT, Criterion, Point
from tuner.objective.normal import Objective
from tuner.objective.segments import CLOCKS
from tuner.search.iteration import Iteration
from tuner.search.loop import USUAL, Loop, loop_of
from tuner.search.optimiser import Iterate
from tuner.search.stages import Stage

HUBER = 4.0
"""Standard deviations beyond which a residual counts linearly, in the polish."""


@dataclass(frozen=True)
class Progress:
    """Where a growing-horizon search stands: all that is needed to go on.

    Attributes
    ----------
    stage
        Number of the stage that comes next, or that is under way where ``iterate`` is not None.
    points
        S points.
    scales
        Channel -> (N,) how much larger than the noise the residuals are taken to be.
    states
        (L, F) starts of the segments, in their standard deviations; None where they are known.
    losses
        (S,) at the end of the last stage.
    iterations
        The trace so far.
    evaluations
        Jacobians, or populations, so far.
    converged
        Whether the last stage ended by itself.
    loop
        How the loop flies where the controller file may be wrong.
    left
        s that the search may still take; NaN where that is unknown.
    damping
        (S,) λ with which the next stage begins.
    steps, iterate
        How many steps of the stage are done, and where the last one led; None between stages.
    """

    stage: int
    points: Point
    scales: dict[str, NDArray[np.float64]]
    states: NDArray[np.float64] | None
    losses: NDArray[np.float64]
    iterations: tuple[Iteration, ...]
    evaluations: int
    damping: NDArray[np.float64]
    converged: bool = False
    loop: Loop = USUAL
    left: float = float("nan")
    steps: int = 0
    iterate: Iterate | None = None

    @property
    def best_point(self) -> Point:
        """The best point so far, the stage under way included."""
        if self.iterate is None:
            return point_of(self.points, int(np.argmin(self.losses)))
        return point_of(self.iterate.points, int(np.argmin(self.iterate.losses)))


def beginning(objective: Objective, vectors: NDArray[np.float64]) -> Progress:
    """Return the state before the first stage for S start vectors (S, K)."""
    offsets = np.zeros((len(vectors), *objective.start(vectors[0]).offsets.shape))
    freedom = objective.segments.freedom
    return Progress(
        stage=0,
        points=Point(np.asarray(vectors), np.asarray(offsets)),
        scales={name: np.ones(objective.flights) for name in objective.segments.measured},
        states=None if freedom is None else np.zeros(freedom.shape),
        losses=np.full(len(vectors), np.inf),
        iterations=(),
        evaluations=0,
        damping=np.ones(len(vectors)),
        loop=loop_of(objective),
    )


def criterion_of(
    stage: Stage,
    scales: dict[str, NDArray[np.float64]],
    offsets: NDArray[np.float64],
    states: NDArray[np.float64] | None = None,
) -> Criterion:
    """Return what the solver needs to know of a stage.

    Parameters
    ----------
    stage, scales
        Horizon and weights.
    offsets
        (offsets, N) at which commands are read exactly, as in a `Point`.
    states
        (L, F) starts around which is linearised.
    """
    return Criterion(
        horizon=np.asarray(stage.horizon),
        scale={name: np.asarray(stage.noise_inflation * scale) for name, scale in scales.items()},
        reference_offset=np.asarray(offsets[: len(CLOCKS)] * OFFSET_UNIT),
        huber=np.asarray(HUBER if stage.robust else np.inf),
        prior=np.asarray(1.0),
        states=None if states is None else np.asarray(states),
    )


def plain_criterion(
    objective: Objective, horizon: int, scales: dict[str, NDArray[np.float64]] | None = None
) -> Criterion:
    """Return the criterion of plain squares up to a horizon in samples, no clock late.

    Residuals count in multiples of the noise, or of ``scales`` times the noise, as in a `Progress`.
    """
    stage = Stage("plain", horizon, 1.0, False, False, 1, 1.0, False, False)
    start = beginning(objective, objective.space.initial[None])
    return criterion_of(
        stage, scales or start.scales, np.asarray(start.points.offsets[0]), start.states
    )


def point_of(points: Point, start: int) -> Point:
    """Return one of S points."""
    picked: Point = jax.tree.map(lambda leaf: leaf[start], points)
    return picked

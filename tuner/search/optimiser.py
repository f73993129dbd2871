"""What an optimiser is: three methods, `init`, `step` and `terminate`.

An optimiser runs one stage of the search. To add one, write a subclass of `Optimiser` with a
``name``: a stage names its optimiser, and so may a job's search method.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from tuner.objective.criterion import Criterion, Point, SegmentSums
from tuner.objective.normal import Objective
from tuner.search.stages import Stage


@dataclass(frozen=True)
class Free:
    """What a search may move.

    Attributes
    ----------
    coefficients
        (K,) of the search vector.
    offsets
        (offsets, N) of the flights.
    """

    coefficients: NDArray[np.bool_]
    offsets: NDArray[np.bool_]


@dataclass(frozen=True)
class StageProblem:
    """What an optimiser minimises in one stage.

    Attributes
    ----------
    objective, criterion
        The loss as a function of a point.
    stage
        How far to look, and when enough is gained.
    points
        The S points to start from.
    losses
        (S,) of the last stage; infinite before the first.
    free
        What may move in this stage.
    seed
        For an optimiser that draws at random; differs from stage to stage.
    damping
        (S,) λ to begin with, for an optimiser that damps its steps.
    last
        Whether no stage follows, so that what is found has to stand.
    sums
        The segments' at the points, where these were flown already.
    """

    objective: Objective
    criterion: Criterion
    stage: Stage
    points: Point
    losses: NDArray[np.float64]
    free: Free
    seed: int
    damping: NDArray[np.float64]
    last: bool
    sums: SegmentSums | None = None

    @property
    def best(self) -> int:
        """The number of the start with the least loss."""
        return int(np.argmin(self.losses))


@dataclass(frozen=True)
class Iterate:
    """Where an optimiser stands after a step.

    Attributes
    ----------
    points
        The best S points so far, each that of its start.
    losses
        (S,) there: half the mean squared residual in (scaled) standard deviations, priors included.
    accepted
        (S,) whether the step found a better point.
    position_rmse
        m, over all flights up to the horizon, at the point tried by the best start.
    damping
        λ of the best start's next step; NaN for an optimiser without.
    sums
        The segments' sums at the best points, S first; None where they were not computed. The next
        stage's weights and starts follow from those of the last step.
    next_start
        What the next stage begins with, if there is one: S points, of which one predicted to differ
        by little has not been tried, and (S,) λ. None for ``points`` and a damping of 1.
    """

    points: Point
    losses: NDArray[np.float64]
    accepted: NDArray[np.bool_]
    position_rmse: float
    damping: float = float("nan")
    sums: SegmentSums | None = None
    next_start: tuple[Point, NDArray[np.float64]] | None = None


class Optimiser(ABC):
    """Minimises a stage's loss step by step; its state is its own affair."""

    name: ClassVar[str]

    def __init_subclass__(cls) -> None:
        OPTIMISERS[cls.name] = cls()

    @abstractmethod
    def init(self, problem: StageProblem) -> Any:
        """Return the state before the first step."""

    @abstractmethod
    def step(self, problem: StageProblem, state: Any) -> tuple[Any, Iterate]:
        """Take one step; return the state after it and where it led."""

    @abstractmethod
    def terminate(self, problem: StageProblem, state: Any) -> bool:
        """Return whether another step would gain nothing; the stage counts the steps itself."""


OPTIMISERS: dict[str, Optimiser] = {}
"""Name -> optimiser."""

"""The result of a search: where it ended, how it got there, and what it noticed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from tuner.core.numerics import Array
from tuner.findings.findings import Finding
from tuner.objective.criterion import Criterion, Point
from tuner.objective.normal import Objective
from tuner.recordings.flight import Flight
from tuner.search.iteration import Iteration, Outcome

COLOURED = 1.2
"""Residuals over measurement noise from which something else than noise must be in them."""


@dataclass(frozen=True)
class Fitted:
    """A search's result.

    Attributes
    ----------
    objective
        The problem.
    point
        The best point.
    criterion
        Horizon, scales and robust limit of the final problem, in which ``point`` is the minimum.
    noise
        Channel -> standard deviation of the measurement in its unit (attitude: rad).
    scales
        Flight name -> channel -> how much larger than the noise the residuals are.
    iterations, outcomes
        The trace of the search, and each start's end.
    method
        ``gradient``, ``cma`` or ``hybrid``.
    evaluations
        Simulated batches, Jacobians included.
    wall_time
        s.
    loss_best
        In the final weights.
    converged
        Whether the last stage stopped because its steps gained nothing, not at its limit.
    polished
        Whether the search went to its end: a model that is far off is not polished before terms
        have been tried.
    findings
        Everything noticed on the way.
    held
        Coefficient that the flights do not identify -> the one kept at its initial value for it:
        itself, or one that it trades off against.
    """

    objective: Objective
    point: Point
    criterion: Criterion
    noise: Mapping[str, float]
    scales: Mapping[str, Mapping[str, float]]
    iterations: tuple[Iteration, ...]
    outcomes: tuple[Outcome, ...]
    method: str
    evaluations: int
    wall_time: float
    loss_best: float
    converged: bool
    polished: bool = True
    findings: tuple[Finding, ...] = field(default=())
    held: Mapping[str, str] = field(default_factory=dict)

    @property
    def vector(self) -> dict[str, float]:
        """Coefficient -> number of the search vector."""
        numbers = np.asarray(self.point.coefficients).tolist()
        return dict(zip(self.objective.space.names, numbers, strict=True))

    @property
    def residuals_at_noise_level(self) -> bool:
        """Whether residuals hold no more than measurement noise, on any flight and channel."""
        return max(max(scale.values()) for scale in self.scales.values()) < COLOURED


def by_flight(
    scales: Mapping[str, Array], flights: Sequence[Flight]
) -> dict[str, dict[str, float]]:
    """Return flight name -> channel -> number, of channel -> (N,) numbers."""
    return {
        flight.name: {channel: float(scale[i]) for channel, scale in scales.items()}
        for i, flight in enumerate(flights)
    }

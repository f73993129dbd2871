"""A vehicle as it is, in the form of a fit that moved nothing, so that it can be examined."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tuner.core.findings import Code, Finding
from tuner.objective.criterion import Criterion, Point
from tuner.objective.normal import Objective
from tuner.search.findings import UNMATCHED, loop_findings
from tuner.search.fitted import Fitted, by_flight
from tuner.search.loop import GAIN, loop_of, with_loop
from tuner.search.problem import Job
from tuner.search.progress import beginning, plain_criterion
from tuner.search.weights import misfit, root_mean_squares
from tuner.vehicle import initial_values


def unfitted(job: Job) -> Fitted:
    """Return the vehicle that a job would start from, as a fit that moved nothing.

    What is undecided of the loop is tried both ways.
    """
    space, configured = job.space, loop_of(job.objective)
    start = initial_values(job.settings.vehicle, job.settings.controller, space.free)
    vector = space.vector_of(start)
    loops = [configured, *map(configured.switched, job.undecided(job.objective))]
    matches = [_match(with_loop(job.objective, loop), vector) for loop in loops]
    match = min(matches, key=lambda match: match.loss)
    if matches[0].loss <= GAIN * match.loss:
        match = matches[0]
    names = [flight.name for flight in job.fitted]
    return Fitted(
        objective=match.objective,
        point=match.point,
        criterion=match.criterion,
        noise=job.noise,
        scales=by_flight(match.scale, job.fitted),
        iterations=(),
        outcomes=(),
        method="none",
        evaluations=len(matches),
        wall_time=0.0,
        loss_best=match.loss,
        converged=True,
        findings=(
            *loop_findings(job, loop_of(match.objective), "info"),
            *_findings(match.scale, names),
        ),
    )


@dataclass(frozen=True)
class _Match:
    """How closely a simulation matches the recordings: the problem, weighed accordingly."""

    objective: Objective
    point: Point
    criterion: Criterion
    scale: dict[str, NDArray[np.float64]]
    loss: float


def _match(objective: Objective, vector: NDArray[np.float64]) -> _Match:
    """Return a problem whose noise is scaled to the residuals where these are larger."""
    point, start = objective.start(vector), beginning(objective, vector[None])
    unscaled = plain_criterion(objective, objective.samples)
    sums = objective.sums_of(start.points, unscaled, derivatives=False)
    scale = misfit(root_mean_squares(objective, start.losses, sums))
    criterion = plain_criterion(objective, objective.samples, scale)
    return _Match(objective, point, criterion, scale, float(np.sum(np.asarray(sums.loss))))


def _findings(scale: Mapping[str, NDArray[np.float64]], names: Sequence[str]) -> Iterator[Finding]:
    for index, name in enumerate(names):
        worst = max(scale, key=lambda channel: scale[channel][index])
        multiple = float(scale[worst][index])
        if multiple > UNMATCHED:
            yield Finding(Code.POORLY_MET, "warning", name, {"noise_multiple": multiple}, (worst,))

"""A search once more with something changed: its last stages from where it ended, or all of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tuner.objective.criterion import Point
from tuner.search.continuation import grow
from tuner.search.estimation import stages_of
from tuner.search.fitted import Fitted, by_flight
from tuner.search.least_squares import LEAST_DAMPING
from tuner.search.loop import loop_of, with_loop
from tuner.search.optimiser import Free
from tuner.search.problem import Job
from tuner.search.progress import Progress, beginning, criterion_of, point_of
from tuner.search.stages import Stage

LAST_TWO, LAST, ROUGHLY = slice(-2, None), slice(-1, None), slice(-2, -1)
"""Stages: polish and polish again, the latter alone where the weights are known, or the former."""
ROUGH = 1e-3
"""Share of the loss that a rough fit leaves to a linear step: a tenth of a term's least gain."""


def polished(
    job: Job,
    fitted: Fitted,
    *,
    free: Free,
    title: str,
    on_progress: Callable[[Progress], None],
    stages: slice = LAST_TWO,
    left: float | None = None,
) -> Fitted:
    """Return a fit polished again, by the last stages from its point.

    Parameters
    ----------
    job
        Gives the settings and the flights' names.
    fitted
        Its objective, which need not be the job's, and the point to begin at.
    free
        What may move.
    title
        What stands before the stages' names in messages.
    on_progress
        Called after every iteration.
    stages
        Which of the stages: of the last two the first weighs what the second polishes.
    left
        Share of the loss that may be left to gain: a rough fit.
    """
    names = [flight.name for flight in job.fitted]
    progress = Progress(
        stage=0,
        points=Point(
            np.asarray(fitted.point.coefficients)[None], np.asarray(fitted.point.offsets)[None]
        ),
        scales={
            channel: np.array([fitted.scales[name][channel] for name in names])
            for channel in fitted.objective.segments.measured
        },
        states=None if fitted.criterion.states is None else np.asarray(fitted.criterion.states),
        losses=np.array([fitted.loss_best]),
        iterations=fitted.iterations,
        evaluations=fitted.evaluations,
        damping=np.array([_damping_of(fitted)]),
        loop=loop_of(fitted.objective),
    )
    return _grown(
        job,
        fitted,
        progress,
        [_rough(stage, left) for stage in stages_of(job, fitted.objective)[stages]],
        free=free,
        undecided=(),
        title=title,
        on_progress=on_progress,
    )


def _damping_of(fitted: Fitted) -> float:
    """Return the damping with which a fit's last step would have been followed."""
    last = fitted.iterations[-1].damping if fitted.iterations else None
    return float(np.clip(last, LEAST_DAMPING, 1.0)) if last else 1.0


def searched_again(
    job: Job,
    fitted: Fitted,
    vector: NDArray[np.float64],
    *,
    free: Free,
    title: str,
    on_progress: Callable[[Progress], None],
) -> Fitted:
    """Return a fit searched for again by all stages from a start vector (K,).

    The other arguments are those of `polished`. What terms that were missing did to a fit, a
    coefficient at its bound say, is forgotten that way; what is undecided of the loop, too, is
    tried both ways again. The fit is rough: the last polish is left to one of what proves to be
    needed.
    """
    progress = replace(
        beginning(fitted.objective, vector[None]),
        iterations=fitted.iterations,
        evaluations=fitted.evaluations,
        loop=loop_of(job.objective),
    )
    *stages, polish, _ = stages_of(job, fitted.objective)
    return _grown(
        job,
        fitted,
        progress,
        (*stages, _rough(polish, ROUGH)),
        free=free,
        undecided=job.undecided(fitted.objective),
        title=title,
        on_progress=on_progress,
    )


def _rough(stage: Stage, left: float | None) -> Stage:
    if left is None:
        return stage
    return replace(stage, tolerance=max(stage.tolerance, left), rough=True)


def _grown(
    job: Job,
    fitted: Fitted,
    progress: Progress,
    stages: Sequence[Stage],
    *,
    free: Free,
    undecided: Sequence[str],
    title: str,
    on_progress: Callable[[Progress], None],
) -> Fitted:
    """Return where some stages lead."""
    stages = tuple(replace(stage, name=f"{title}, {stage.name}") for stage in stages)
    objective, last = fitted.objective, stages[-1]
    progress = grow(
        objective, stages, progress, free=free, undecided=undecided, on_progress=on_progress
    )
    point = point_of(progress.points, 0)
    return replace(
        fitted,
        objective=with_loop(objective, progress.loop),
        point=point,
        criterion=criterion_of(last, progress.scales, np.asarray(point.offsets), progress.states),
        scales=by_flight(progress.scales, job.fitted),
        iterations=progress.iterations,
        evaluations=progress.evaluations,
        loss_best=float(progress.losses[0]),
        converged=progress.converged,
        polished=True,
    )

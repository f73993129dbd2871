"""The last stages of a search once more, from where it ended, with something changed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from tuner.job.prepare import Job
from tuner.objective.criterion import Point
from tuner.search.continuation import grow
from tuner.search.fitted import Fitted
from tuner.search.optimiser import Free
from tuner.search.progress import Progress, criterion_of, point_of
from tuner.search.stages import plan


def polished(
    job: Job,
    fitted: Fitted,
    *,
    free: Free,
    title: str,
    on_progress: Callable[[Progress], None],
) -> Fitted:
    """Return a fit polished again.

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
    """
    objective, settings = fitted.objective, job.settings.job.search
    *_, first, last = plan(
        "gradient",
        objective.samples,
        float(objective.schedule.log_rate),
        windows=objective.segments.freedom is not None,
        robust=settings.robust == "huber",
        steps=settings.max_iterations,
    )
    stages = tuple(replace(stage, name=f"{title}, {stage.name}") for stage in (first, last))
    names = [flight.name for flight in job.fitted]
    progress = Progress(
        stage=0,
        points=Point(
            jnp.asarray(fitted.point.coefficients)[None], jnp.asarray(fitted.point.offsets)[None]
        ),
        scales={
            channel: np.array([fitted.scales[name][channel] for name in names])
            for channel in objective.segments.measured
        },
        states=None if fitted.criterion.states is None else np.asarray(fitted.criterion.states),
        losses=np.array([fitted.loss_best]),
        iterations=fitted.iterations,
        evaluations=fitted.evaluations,
        feedback=float(objective.model.controller.rate.saturation_feedback),
    )
    progress = grow(objective, stages, progress, free=free, clipped=False, on_progress=on_progress)
    point = point_of(progress.points, 0)
    return replace(
        fitted,
        point=point,
        criterion=criterion_of(last, progress.scales, np.asarray(point.offsets), progress.states),
        scales={
            name: {channel: float(scale[i]) for channel, scale in progress.scales.items()}
            for i, name in enumerate(names)
        },
        iterations=progress.iterations,
        evaluations=progress.evaluations,
        loss_best=float(progress.losses[0]),
        converged=progress.converged,
    )

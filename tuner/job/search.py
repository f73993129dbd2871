"""The search of a job, with its checkpoint: started, interrupted, gone on with."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from tuner.findings import Code, Finding
from tuner.job.checkpoint import fingerprint, load, save
from tuner.job.findings import end_findings, offset_findings, unmatched
from tuner.job.prepare import Job
from tuner.job.starts import starting_vectors
from tuner.objective.criterion import OFFSET_UNIT, Criterion, Point
from tuner.objective.normal import Objective
from tuner.objective.segments import CLOCKS, OFFSETS
from tuner.search.continuation import grow
from tuner.search.fitted import Fitted, Outcome
from tuner.search.levenberg_marquardt import total
from tuner.search.progress import (
    Free,
    Progress,
    beginning,
    criterion_of,
    point_of,
    with_feedback,
)
from tuner.search.stages import Stage, left, plan

CHECKPOINT = "checkpoint.npz"
SECOND_CHECKPOINT = "checkpoint_hybrid.npz"
AGREE = 0.01
"""Starts whose losses differ by less than this share have reached the same minimum."""


def search(
    job: Job,
    folder: Path,
    *,
    resume: bool,
    tell: Callable[[Job, Progress], None],
    findings: tuple[Finding, ...] = (),
) -> Fitted:
    """Look for the best coefficients of a job.

    Parameters
    ----------
    job
        The problem.
    folder
        Where the checkpoint lies.
    resume
        Go on from the checkpoint.
    tell
        Called after every iteration.
    findings
        Of the check before the search, to be handed on.

    Raises
    ------
    InputError
        There is no checkpoint to resume from, or it belongs to another job.
    """
    said = job.settings.job.search.method
    method = "gradient" if said == "auto" else said
    found = _run(job, folder / CHECKPOINT, method, resume=resume, tell=tell, findings=findings)
    doubt = _doubt(job, found) if said == "auto" else None
    if doubt is None:
        return found
    resume = resume and (folder / SECOND_CHECKPOINT).exists()
    rival = _run(
        job, folder / SECOND_CHECKPOINT, "hybrid", resume=resume, tell=tell, findings=findings
    )
    better = rival if _misfit(rival) < _misfit(found) else found
    doubt = replace(doubt, numbers={**doubt.numbers, "changed": float(better is rival)})
    return replace(
        better,
        method="auto",
        evaluations=found.evaluations + rival.evaluations,
        wall_time=found.wall_time + rival.wall_time,
        outcomes=(*found.outcomes, *rival.outcomes),
        findings=(*better.findings, doubt),
    )


def _doubt(job: Job, fitted: Fitted) -> Finding | None:
    """Return why the end of least squares is doubtful, if it is."""
    losses = np.array([outcome.loss for outcome in fitted.outcomes])
    if len(losses) > 2 and (losses < (1.0 + AGREE) * losses.min()).sum() < 2:
        return Finding(Code.STARTS_DISAGREE, "info", "search", {"starts": len(losses)})
    lost = unmatched(fitted.scales)
    if set(job.inlets) == {"reference"} and len(lost) > len(job.fitted) / 2:
        numbers = {"far_off": len(lost), "flights": len(job.fitted)}
        return Finding(Code.FLIGHTS_FAR_OFF, "info", "search", numbers)
    return None


def _misfit(found: Fitted) -> float:
    """Return how far all channels of all flights are met, each by its own noise."""
    return float(np.mean([np.log(s) for scale in found.scales.values() for s in scale.values()]))


def _run(
    job: Job,
    checkpoint: Path,
    method: str,
    *,
    resume: bool,
    tell: Callable[[Job, Progress], None],
    findings: tuple[Finding, ...],
) -> Fitted:
    """Run one method from the starts, or from where its checkpoint stands."""
    objective, settings = job.objective, job.settings.job.search
    stages = plan(
        method,
        objective.samples,
        float(objective.schedule.log_rate),
        windows=objective.segments.freedom is not None,
        robust=settings.robust == "huber",
        steps=settings.max_iterations,
    )
    starts = starting_vectors(job)
    free = Free(np.ones(len(job.space), bool), free_offsets(job))
    if job.windows is not None:
        stages = tuple(stage for stage in stages if stage.horizon == objective.samples)
    progress, spent = beginning(objective, starts), 0.0
    key = fingerprint(job)
    if resume:
        progress, spent = load(checkpoint, key, progress)
    clock = time.perf_counter()

    def keep(now: Progress) -> None:
        seconds = spent + time.perf_counter() - clock
        save(checkpoint, key, now, seconds)
        tell(job, replace(now, left=left(stages, now.stage, len(now.trail), seconds)))

    if job.windows is not None and not resume:
        progress = beginning(objective, _through_windows(job, starts, free))
    for reached in grow(
        objective, stages, progress, free=free, clipped=job.clipped, tell=keep, seed=settings.seed
    ):
        progress = reached
    save(checkpoint, key, progress, spent + time.perf_counter() - clock)
    spent += time.perf_counter() - clock
    return _fitted(
        job, stages[-1], progress, starts, method=method, seconds=spent, findings=findings
    )


def _through_windows(job: Job, starts: NDArray[np.float64], free: Free) -> NDArray[np.float64]:
    """Return where windows lead each start (S, K), for flights that do not begin gently."""
    objective, settings = job.windows, job.settings.job.search
    assert objective is not None
    stages = plan(
        "gradient",
        objective.samples,
        float(objective.schedule.log_rate),
        windows=True,
        robust=settings.robust == "huber",
        steps=settings.max_iterations,
    )
    progress = beginning(objective, starts)
    for reached in grow(
        objective, stages[:-1], progress, free=free, clipped=False, tell=lambda _: None
    ):
        progress = reached
    return np.asarray(progress.points.coefficients)


def free_offsets(job: Job) -> NDArray[np.bool_]:
    """Return (offsets, N) which offsets of which flight are fitted.

    What enters below the reference does so on the flight controller's clock, which then is the
    simulation's own.
    """
    free = np.ones((len(OFFSETS), len(job.fitted)), bool)
    free[: len(CLOCKS), list(job.offset_is_fixed)] = False
    fed = [inlet != "reference" for inlet in job.inlets]
    free[CLOCKS.index("flight_controller"), fed] = False
    return free


def _fitted(
    job: Job,
    stage: Stage,
    progress: Progress,
    starts: NDArray[np.float64],
    *,
    method: str,
    seconds: float,
    findings: tuple[Finding, ...],
) -> Fitted:
    best = int(np.argmin(progress.losses))
    point = point_of(progress.points, best)
    objective = with_feedback(job.objective, progress.feedback)
    criterion = criterion_of(stage, progress.scales, np.asarray(point.offsets), progress.states)
    vectors = np.asarray(progress.points.coefficients)
    outcomes = tuple(
        Outcome(vectors[i], starts[i], float(progress.losses[i]), _origin(i))
        for i in range(len(starts))
    )
    names = [flight.name for flight in job.fitted]
    scales = {
        name: {channel: float(progress.scales[channel][i]) for channel in progress.scales}
        for i, name in enumerate(names)
    }
    return Fitted(
        objective=objective,
        point=point,
        criterion=criterion,
        noise=job.noise,
        scales=scales,
        iterations=progress.iterations,
        outcomes=outcomes,
        method=method,
        evaluations=progress.evaluations,
        wall_time=seconds,
        loss_initial=_loss_at(objective, objective.start(starts[0]), criterion),
        loss_best=float(progress.losses[best]),
        converged=progress.converged,
        findings=(
            *findings,
            *end_findings(job, progress.feedback, scales),
            *offset_findings(job, np.asarray(point.offsets) * OFFSET_UNIT),
        ),
    )


def _origin(number: int) -> str:
    return "vehicle file" if number == 0 else "random"


def _loss_at(objective: Objective, point: Point, criterion: Criterion) -> float:
    """Return the loss at a point, as the search counts it."""
    flight = np.asarray(objective.segments.flight)
    return float(
        total(objective.space, flight, point, criterion, objective.sums(point, criterion))[0]
    )


def parameters_of(job: Job, progress: Progress) -> Mapping[str, float]:
    """Return the best coefficients so far."""
    best = int(np.argmin(progress.trail[-1] if progress.trail else progress.losses))
    points = progress.points if progress.step is None else progress.step.point
    values = job.space.values(jnp.asarray(points.coefficients[best]))
    return {name: float(value) for name, value in values.items()}

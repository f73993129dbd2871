"""The search of a job, started or resumed from a checkpoint, and refits with something changed.

Refits run the last stages from the search's end, or all stages.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from tuner.core.disk import whole_file
from tuner.core.errors import InputError
from tuner.core.files import read_arrays
from tuner.core.numerics import Array
from tuner.findings.findings import Code, Finding
from tuner.objective.criterion import Point, picked
from tuner.objective.inlets import INLETS
from tuner.objective.normal_equations import Objective
from tuner.objective.segments import CLOCKS, OFFSETS
from tuner.objective.space import Space
from tuner.recordings.content import ReadOptions
from tuner.recordings.loader import reading_key
from tuner.search.continuation import Undecided, run_stages
from tuner.search.findings import unmatched, with_end_findings
from tuner.search.listener import Iteration, Outcome
from tuner.search.optimisers import MIN_DAMPING
from tuner.search.problem import Job
from tuner.search.progress import (
    Fit,
    Loop,
    Progress,
    by_flight,
    clocks_are_late,
    criterion_of,
    initial_progress,
    loop_of,
    with_loop,
)
from tuner.search.stages import Stage, plan, remaining_seconds


def fingerprint(job: Job) -> str:
    """Return a digest of everything that a job's numbers depend on."""
    settings, job_file = job.settings, job.settings.job
    # a topic map or a side-car may change
    read_by = {
        flight.path: reading_key(
            ReadOptions.of(Path(flight.path), job_file.topics, job_file.namespace)
        )
        for flight in job.flights
    }
    parts = {
        "flights": [(flight.name, flight.sha256, *read_by[flight.path]) for flight in job.flights],
        "vehicle": settings.vehicle.model_dump(mode="json"),
        "controller": settings.controller.model_dump(mode="json"),
        "job": job_file.model_dump(mode="json"),
    }
    if settings.bench is not None:
        parts["bench"] = [settings.bench.mean.tolist(), settings.bench.information.tolist()]
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


def save(path: Path, key: str, progress: Progress, seconds: float) -> None:
    """Write a checkpoint that appears whole: the stage under way begins again when resumed."""
    done = len(progress.iterations) - progress.steps
    head = {
        "key": key,
        "stage": progress.stage,
        "evaluations": progress.evaluations - progress.steps,
        "converged": progress.converged,
        "loop": progress.loop._asdict(),
        "seconds": seconds,
        "iterations": [iteration.model_dump() for iteration in progress.iterations[:done]],
        "channels": list(progress.scales),
    }
    with whole_file(path) as unfinished, unfinished.open("wb") as file:
        np.savez(
            file,
            head=np.frombuffer(json.dumps(head).encode(), np.uint8),
            coefficients=np.asarray(progress.points.coefficients),
            offsets=np.asarray(progress.points.offsets),
            scales=np.stack(list(progress.scales.values())),
            losses=progress.losses,
            damping=progress.damping,
            states=np.zeros(0) if progress.states is None else progress.states,
        )


def load(path: Path, key: str, fresh: Progress) -> tuple[Progress, float]:
    """Return a checkpoint's progress and the s that the search had taken.

    Raises
    ------
    InputError
        There is no checkpoint, it belongs to another job, or it cannot be read.
    """
    if not path.exists():
        raise InputError(path, "there is no checkpoint to resume from", "leave --resume out")
    data = read_arrays(path, remedy="leave --resume out")
    try:
        head = json.loads(data["head"].tobytes())
        if head["key"] != key:
            raise InputError(path, "belongs to other flights or settings", "leave --resume out")
        progress = replace(
            fresh,
            stage=head["stage"],
            points=Point(np.asarray(data["coefficients"]), np.asarray(data["offsets"])),
            scales=dict(zip(head["channels"], data["scales"], strict=True)),
            losses=data["losses"],
            damping=data["damping"],
            states=data["states"] if data["states"].size else None,
            iterations=tuple(Iteration(**iteration) for iteration in head["iterations"]),
            evaluations=head["evaluations"],
            converged=head["converged"],
            loop=Loop(**head["loop"]),
        )
        if _form(progress) != _form(fresh) or progress.stage < 0:
            raise ValueError("it holds other numbers than a search of this job")
        return progress, float(head["seconds"])
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(path, f"is no checkpoint ({error!r})", "leave --resume out") from None


def _form(progress: Progress) -> tuple[object, ...]:
    """Return shape, type and finiteness of the arrays of a search's state."""
    scales, states = progress.scales, progress.states
    finite = [
        progress.points.coefficients,
        progress.points.offsets,
        *map(scales.get, sorted(scales)),
    ]
    finite.append(np.zeros(0) if states is None else states)
    return (
        sorted(scales),
        [(a.shape, a.dtype, np.isfinite(a).all()) for a in map(np.asarray, finite)],
        [(a.shape, a.dtype) for a in (progress.losses, progress.damping)],
    )


CHECKPOINT = "checkpoint.npz"
SECOND_CHECKPOINT = "checkpoint_hybrid.npz"
FAR_OFF_RATIO = 3.0
"""Residuals over noise beyond which a flight is too far off for a polish before terms are tried."""
FAR_OFF_TOLERANCE = 0.1
"""Share of the loss below which a step is not worth the next one while most flights are far off
and terms are still to be tried."""
SAME_MINIMUM_TOLERANCE = 0.01
"""Relative difference of losses below which starts have reached the same minimum."""
BOUND_MARGIN = 0.02
"""Share of its range by which a start keeps away from a bound."""
BOTH_POLISHES, LAST_POLISH, FIRST_POLISH, ALL_BUT_LAST = (
    slice(*ends) for ends in ((-2, None), (-1, None), (-2, -1), (None, -1))
)
"""Stages of a refit: the first polish finds the weights of the last."""
ROUGH_TOLERANCE = 1e-3
"""Share of the loss that a rough fit leaves to a linear step: a tenth of a term's least gain."""

OnProgress = Callable[[Job, Progress], None]


def search(
    job: Job,
    folder: Path,
    *,
    resume: bool,
    on_progress: OnProgress,
    findings: tuple[Finding, ...] = (),
    provisional: bool = False,
) -> Fit:
    """Search for the best coefficients of a job.

    With the method ``auto``, ``hybrid`` follows least squares where its end is doubtful.

    Parameters
    ----------
    job
        The problem.
    folder
        Where the checkpoint lies.
    resume
        Go on from the checkpoint.
    on_progress
        Called after every iteration.
    findings
        Findings of the check before the search, kept in the result.
    provisional
        Whether to end before the polish where most flights are still far off: the model may lack
        terms. The search can be resumed.

    Raises
    ------
    InputError
        There is no checkpoint to resume from, or it belongs to another job.
    """
    attempt = partial(
        _attempt, job, on_progress=on_progress, findings=findings, provisional=provisional
    )
    method = job.settings.job.search.method
    first = "gradient" if method == "auto" else method
    fitted = attempt(folder / CHECKPOINT, first, resume=resume)
    doubt = _doubt(job, fitted) if method == "auto" and fitted.polished else None
    if doubt is None:
        return fitted
    checkpoint = folder / SECOND_CHECKPOINT
    rival = attempt(checkpoint, "hybrid", resume=resume and checkpoint.exists())
    better = rival if _misfit(rival) < _misfit(fitted) else fitted
    doubt = replace(doubt, numbers={**doubt.numbers, "changed": float(better is rival)})
    return replace(
        better,
        method="auto",
        evaluations=fitted.evaluations + rival.evaluations,
        wall_time=fitted.wall_time + rival.wall_time,
        outcomes=(*fitted.outcomes, *rival.outcomes),
        findings=(*better.findings, doubt),
    )


def _doubt(job: Job, fitted: Fit) -> Finding | None:
    """Return the finding that the end of least squares is doubtful, if it is."""
    losses = np.array([np.inf if end.loss is None else end.loss for end in fitted.outcomes])
    if len(losses) > 2 and (losses < (1.0 + SAME_MINIMUM_TOLERANCE) * losses.min()).sum() < 2:
        return Code.STARTS_DISAGREE.info("search", starts=len(losses))
    far_off = unmatched(fitted.scales)
    if (
        all(INLETS[inlet].closed_loop for inlet in job.inlets)
        and len(far_off) > len(job.fitted) / 2
    ):
        return Code.FLIGHTS_FAR_OFF.info("search", far_off=len(far_off), flights=len(job.fitted))
    return None


def _is_far_off(progress: Progress) -> bool:
    """Return whether a channel of most flights has residuals far above the noise."""
    worst = np.max(list(progress.scales.values()), axis=0)
    return bool(np.median(worst) > FAR_OFF_RATIO)


def _misfit(fitted: Fit) -> float:
    """Return the mean logarithm of residuals over noise, of all channels of all flights."""
    return float(np.mean([np.log(s) for scale in fitted.scales.values() for s in scale.values()]))


def _attempt(
    job: Job,
    checkpoint: Path,
    method: str,
    *,
    resume: bool,
    on_progress: OnProgress,
    findings: tuple[Finding, ...],
    provisional: bool,
) -> Fit:
    """Run one method from the starts, or from its checkpoint."""
    key, starts = fingerprint(job), starting_vectors(job)
    stages = stages_of(job, job.objective, method)
    if job.windows is not None:  # windows replace the stages of short horizons
        stages = tuple(stage for stage in stages if stage.horizon == job.objective.samples)
    if provisional:
        stages = with_far_off_tolerance(stages)
    free = free_parameters(job)
    start, spent = initial_progress(job.objective, starts), 0.0
    progress = start
    if resume:
        progress, spent = load(checkpoint, key, start)
    began = time.perf_counter() - spent

    def keep(progress: Progress) -> None:
        seconds = time.perf_counter() - began
        save(checkpoint, key, progress, seconds)
        remaining = remaining_seconds(stages, progress.stage, progress.steps, seconds)
        on_progress(job, replace(progress, left=remaining))

    if job.windows is not None and not resume:
        # flights that do not begin gently are searched in windows first
        through = run_stages(
            job.windows,
            stages_of(job, job.windows)[:-1],
            initial_progress(job.windows, starts),
            free=free,
            undecided={},
            on_progress=lambda _: None,
        )
        shares = job.space.share(through.points.coefficients)
        progress = initial_progress(job.objective, _off_bounds(job.space, shares))
    progress = run_stages(
        job.objective,
        stages,
        progress,
        free=free,
        undecided=job.undecided(job.objective),
        on_progress=keep,
        seed=job.settings.job.search.seed,
        worth_polishing=lambda progress: not (provisional and _is_far_off(progress)),
        start=start,
        clocks_are_late=clocks_are_late(job.fitted),
    )
    seconds = time.perf_counter() - began
    save(checkpoint, key, progress, seconds)
    ends = zip(starts, progress.points.coefficients, progress.losses, strict=True)
    fitted = Fit(
        **_end(job, job.objective, stages[-1], progress),
        noise=job.noise,
        outcomes=tuple(
            Outcome(
                origin="random" if number else "vehicle file",
                loss=float(loss),
                start=job.space.numbers(start),
                end=job.space.numbers(end),
            )
            for number, (start, end, loss) in enumerate(ends)
        ),
        method=method,
        wall_time=seconds,
        polished=progress.stage == len(stages),
    )
    return with_end_findings(job, replace(fitted, findings=findings))


def _end(job: Job, objective: Objective, stage: Stage, progress: Progress) -> dict[str, Any]:
    """Return the fields of a `Fit` at the end of a search's last stage."""
    best = int(np.argmin(progress.losses))
    point = picked(progress.points, best)
    return {
        "objective": with_loop(objective, progress.loop),
        "point": point,
        "criterion": criterion_of(stage, progress.scales, point.offsets, progress.states),
        "scales": by_flight(progress.scales, job.fitted),
        "iterations": progress.iterations,
        "evaluations": progress.evaluations,
        "loss_best": float(progress.losses[best]),
        "converged": progress.converged,
    }


def stages_of(job: Job, objective: Objective, method: str = "gradient") -> tuple[Stage, ...]:
    """Return a method's stages for an objective of the job."""
    settings = job.settings.job.search
    return plan(
        method,
        objective.samples,
        float(objective.schedule.log_rate),
        windows=objective.segments.windowed,
        robust=settings.robust == "huber",
        steps=settings.max_iterations,
    )


def with_far_off_tolerance(stages: Sequence[Stage]) -> tuple[Stage, ...]:
    """Return stages of which the long ones end early where most flights stay far off."""
    return tuple(
        replace(stage, far_off_tolerance=FAR_OFF_TOLERANCE)
        if stage.offsets and not stage.drops_offsets
        else stage
        for stage in stages
    )


def free_parameters(job: Job, *, held: Collection[str] = ()) -> Point:
    """Return which coefficients (K,), and which offsets (offsets, N) of which flight, are fitted.

    All coefficients of the job but those ``held``. Inputs below the reference have the flight
    controller's stamps, which are then the simulation's.
    """
    free = np.ones((len(job.objective.of_flight), len(job.fitted)), bool)
    clock_given = [r.time_offset is not None for r in job.recordings if not r.holdout]
    free[: len(CLOCKS), clock_given] = False
    fed = [not INLETS[inlet].closed_loop for inlet in job.inlets]
    free[CLOCKS.index("flight_controller"), fed] = False
    if job.objective.segments.windowed and job.objective.segments.start_sd is None:
        free[: len(OFFSETS)] = False  # a recorded start has the recording's clock and bias
    return Point(np.array([name not in held for name in job.space.names], bool), free)


def starting_vectors(job: Job) -> Array:
    """Return S start vectors (S, K): the vehicle file's, then random ones around it.

    A logarithmic coefficient is drawn between the vehicle file's value divided by the job's
    ``spread`` and that value times it, evenly in the logarithm; a linear one evenly within its
    usual uncertainty on either side.
    """
    settings, space = job.settings.job.search, job.space
    generator = np.random.default_rng(settings.seed)
    first = space.initial
    centre, width = space.share(first), space.width
    reach = np.where(space.is_log, np.log(settings.spread), space.prior_sd) / width
    drawn = generator.uniform(-1.0, 1.0, (settings.starts - 1, len(space)))
    return np.vstack([first, _off_bounds(space, centre + drawn * reach)])


def _off_bounds(space: Space, shares: Array) -> Array:
    """Return search vectors (S, K) away from bounds, where there is no slope to leave them by."""
    return space.at_share(np.clip(shares, BOUND_MARGIN, 1.0 - BOUND_MARGIN))


def polished(
    job: Job,
    fitted: Fit,
    *,
    free: Point,
    title: str,
    on_progress: Callable[[Progress], None],
    stages: slice = BOTH_POLISHES,
    left: float | None = None,
    start: Array | None = None,
) -> Fit:
    """Return a fit searched again, by some stages from its point or from a start vector.

    A search from a start forgets the bias by missing terms, such as a coefficient at its bound; the
    loop's choices are tried both ways again, and neither is preferred where the fit overruled the
    controller file.

    Parameters
    ----------
    job
        Gives the settings and the flights' names.
    fitted
        Its objective, which need not be the job's, and the point to begin at.
    free
        Which parameters may move.
    title
        Prefix of the stages' names in messages.
    on_progress
        Called after every iteration.
    stages
        Which of the stages to run.
    left
        Share of the loss that each of them may leave to gain, of a start the last, for a rough fit.
    start
        (K,) vector to begin at; the fit's point by default.
    """
    objective, point = fitted.objective, fitted.point
    undecided: Undecided = {}
    overruled: list[str] = []
    if start is None:
        last = fitted.iterations[-1].damping if fitted.iterations else None
        progress = replace(
            initial_progress(objective, point.coefficients[None]),
            points=Point(point.coefficients[None], point.offsets[None]),
            scales={
                channel: np.array([fitted.scales[flight.name][channel] for flight in job.fitted])
                for channel in objective.segments.measured
            },
            states=fitted.criterion.states,
            losses=np.array([fitted.loss_best]),
            damping=np.array([np.clip(last, MIN_DAMPING, 1.0) if last else 1.0]),
        )
    else:
        undecided, of_file = job.undecided(objective), loop_of(job.objective)
        both = zip(Loop._fields, of_file, loop_of(objective), strict=True)
        overruled = [choice for choice, wanted, found in both if found != wanted]
        progress = replace(initial_progress(objective, start[None]), loop=of_file)
    progress = replace(progress, iterations=fitted.iterations, evaluations=fitted.evaluations)
    planned = stages_of(job, objective)[stages]
    named = tuple(replace(stage, name=f"{title}, {stage.name}") for stage in planned)
    if left is not None:
        exact = 0 if start is None else len(named) - 1
        rough = (
            replace(stage, tolerance=max(stage.tolerance, left), rough=True)
            for stage in named[exact:]
        )
        named = (*named[:exact], *rough)
    progress = run_stages(
        objective,
        named,
        progress,
        free=free,
        undecided=undecided,
        on_progress=on_progress,
        overruled=overruled,
        clocks_are_late=clocks_are_late(job.fitted),
    )
    changed = _end(job, objective, named[-1], progress)
    return with_end_findings(job, replace(fitted, **changed, polished=True))

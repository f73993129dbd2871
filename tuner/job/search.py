"""The search of a job, with its checkpoint: started, interrupted, gone on with."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from tuner.errors import InputError
from tuner.job.prepare import Job, given_offset
from tuner.objective.lanes import CLOCKS, OFFSETS
from tuner.objective.normal import Objective, Point, Stage
from tuner.search.fitted import Finding, Fitted, Iteration, Outcome
from tuner.search.growing import (
    Leg,
    Progress,
    beginning,
    grow,
    point_of,
    schedule_of,
    stage_of,
    window_schedule,
    with_feedback,
)
from tuner.search.levenberg_marquardt import total

CHECKPOINT = "checkpoint.npz"
SPREAD = np.log(1.7)
"""Standard deviation of random starts around the vehicle file's, in the scaled coordinate."""


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
    objective, settings = job.objective, job.settings.job.search
    rate = float(objective.schedule.log_rate)
    legs_for = schedule_of if objective.lanes.freedom is None else window_schedule
    legs = legs_for(
        objective.samples,
        rate,
        robust=settings.robust == "huber",
        steps=settings.max_iterations,
    )
    starts = starting_vectors(job)
    progress, spent = beginning(objective, starts), 0.0
    path, key = folder / CHECKPOINT, fingerprint(job)
    if resume:
        progress, spent = _load(path, key, progress)
    clock = time.perf_counter()

    def keep(now: Progress) -> None:
        _save(path, key, now, spent + time.perf_counter() - clock)
        tell(job, now)

    for reached in grow(
        objective,
        legs,
        progress,
        free_offsets=free_offsets(job),
        clipped=job.clipped,
        tell=keep,
    ):
        progress = reached
    spent += time.perf_counter() - clock
    return _fitted(job, legs[-1], progress, starts, wall_time=spent, findings=findings)


def free_offsets(job: Job) -> NDArray[np.bool_]:
    """Return (offsets, N) which offsets of which flight are fitted.

    What enters below the reference does so on the flight controller's clock, which then is the
    simulation's own.
    """
    free = np.ones((len(OFFSETS), len(job.fitted)), bool)
    fixed = [given_offset(job.settings, flight.name) is not None for flight in job.fitted]
    free[: len(CLOCKS), fixed] = False
    if job.inlet != "reference":
        free[CLOCKS.index("flight_controller")] = False
    return free


def starting_vectors(job: Job) -> NDArray[np.float64]:
    """Return S start vectors (S, K): the vehicle file's, then random ones around it."""
    settings, space = job.settings.job.search, job.space
    generator = np.random.default_rng(settings.seed)
    first = space.initial
    slope = space.slope(first)
    others = [
        first + SPREAD * generator.standard_normal(len(space)) / np.maximum(slope, 0.2)
        for _ in range(settings.starts - 1)
    ]
    return np.stack([first, *others])


def _fitted(
    job: Job,
    leg: Leg,
    progress: Progress,
    starts: NDArray[np.float64],
    *,
    wall_time: float,
    findings: tuple[Finding, ...],
) -> Fitted:
    best = int(np.argmin(progress.losses))
    point = point_of(progress.points, best)
    objective = with_feedback(job.objective, progress.feedback)
    stage = stage_of(leg, progress.scales, np.asarray(point.offsets), progress.states)
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
        stage=stage,
        noise=job.noise,
        scales=scales,
        iterations=progress.iterations,
        outcomes=outcomes,
        method="gradient",
        evaluations=progress.evaluations,
        wall_time=wall_time,
        loss_initial=_loss_at(objective, objective.start(starts[0]), stage),
        loss_best=float(progress.losses[best]),
        converged=progress.converged,
        message="the last steps gained nothing" if progress.converged else "stopped at its limit",
        findings=(*findings, *_findings(job, progress)),
    )


def _origin(number: int) -> str:
    return "vehicle file" if number == 0 else "random"


def _loss_at(objective: Objective, point: Point, stage: Stage) -> float:
    """Return the loss at a point, as the search counts it."""
    flight = np.asarray(objective.lanes.flight)
    return float(total(objective.space, flight, point, stage, objective.sums(point, stage))[0])


def _findings(job: Job, progress: Progress) -> tuple[Finding, ...]:
    found: list[Finding] = []
    said = 1.0 if job.settings.controller.mixer.saturation_feedback else 0.0
    if progress.feedback != said:
        found.append(
            Finding(
                "warning",
                "saturation_feedback",
                "rotors were clipped low, and the recording agrees with a rate integrator that "
                + ("does not stop then" if progress.feedback == 0 else "stops then")
                + f"; fitted with mixer.saturation_feedback: {str(progress.feedback == 1).lower()}",
                "say so in the controller file",
            )
        )
    for index, flight in enumerate(job.fitted):
        worst = {name: float(scale[index]) for name, scale in progress.scales.items()}
        bad = {name: value for name, value in worst.items() if value > UNMATCHED}
        if len(bad) > len(worst) / 2:
            text = ", ".join(f"{name} {value:.1f}" for name, value in bad.items())
            found.append(
                Finding(
                    "warning",
                    flight.name,
                    f"cannot be matched: residuals in multiples of the noise are {text}; "
                    "it was weighed down accordingly",
                    "look at its plots: wrong controller, clock, wind, damage, or another vehicle",
                )
            )
    return tuple(found)


UNMATCHED = 10.0
"""Multiple of the noise beyond which a channel counts as not matched."""


def fingerprint(job: Job) -> str:
    """Return a digest of everything that decides a job's numbers."""
    settings = job.settings
    parts = {
        "flights": [(flight.name, flight.sha256) for flight in job.flights],
        "vehicle": settings.vehicle.model_dump(mode="json"),
        "controller": settings.controller.model_dump(mode="json"),
        "job": settings.job.model_dump(mode="json"),
    }
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


def _save(path: Path, key: str, progress: Progress, seconds: float) -> None:
    """Write a checkpoint that appears whole: the leg under way begins again when resumed."""
    done = len(progress.iterations) - len(progress.trail)
    head = {
        "key": key,
        "leg": progress.leg,
        "evaluations": progress.evaluations - len(progress.trail),
        "feedback": progress.feedback,
        "seconds": seconds,
        "iterations": [asdict(iteration) for iteration in progress.iterations[:done]],
        "channels": list(progress.scales),
    }
    temporary = path.with_suffix(".tmp")
    with temporary.open("wb") as file:
        np.savez(
            file,
            head=np.frombuffer(json.dumps(head).encode(), np.uint8),
            coefficients=np.asarray(progress.points.coefficients),
            offsets=np.asarray(progress.points.offsets),
            scales=np.stack(list(progress.scales.values())),
            losses=progress.losses,
            states=np.zeros(0) if progress.states is None else progress.states,
        )
    temporary.replace(path)


def _load(path: Path, key: str, fresh: Progress) -> tuple[Progress, float]:
    if not path.exists():
        raise InputError(path, "there is no checkpoint to resume from", "leave --resume out")
    try:
        with np.load(path, allow_pickle=False) as data:
            head = json.loads(data["head"].tobytes())
            if head["key"] != key:
                raise InputError(path, "belongs to other flights or settings", "leave --resume out")
            progress = replace(
                fresh,
                leg=head["leg"],
                points=Point(jnp.asarray(data["coefficients"]), jnp.asarray(data["offsets"])),
                scales=dict(zip(head["channels"], data["scales"], strict=True)),
                losses=data["losses"],
                states=data["states"] if data["states"].size else None,
                iterations=tuple(Iteration(**one) for one in head["iterations"]),
                evaluations=head["evaluations"],
                feedback=head["feedback"],
            )
            return progress, float(head["seconds"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            path, f"cannot be read ({type(error).__name__})", "leave --resume out"
        ) from None


def parameters_of(job: Job, progress: Progress) -> Mapping[str, float]:
    """Return the best coefficients so far."""
    best = int(np.argmin(progress.trail[-1] if progress.trail else progress.losses))
    points = progress.points if progress.step is None else progress.step.point
    values = job.space.values(jnp.asarray(points.coefficients[best]))
    return {name: float(value) for name, value in values.items()}

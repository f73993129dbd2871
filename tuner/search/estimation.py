"""The search of a job, with its checkpoint: started, interrupted, gone on with."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tuner.core.disk import whole_file
from tuner.core.errors import InputError
from tuner.core.files import read_arrays
from tuner.findings.findings import Code, Finding
from tuner.objective.criterion import Point
from tuner.objective.inlets import INLETS
from tuner.objective.normal import Objective
from tuner.objective.segments import CLOCKS, OFFSETS
from tuner.search.continuation import grow
from tuner.search.findings import findings_at, unmatched
from tuner.search.fitted import Fitted, by_flight
from tuner.search.iteration import Iteration, Outcome
from tuner.search.loop import Loop, with_loop
from tuner.search.optimiser import Free
from tuner.search.problem import Job
from tuner.search.progress import Progress, beginning, criterion_of, point_of
from tuner.search.stages import Stage, left, plan


def fingerprint(job: Job) -> str:
    """Return a digest of everything that decides a job's numbers."""
    settings = job.settings
    parts = {
        "flights": [(flight.name, flight.sha256) for flight in job.flights],
        "vehicle": settings.vehicle.model_dump(mode="json"),
        "controller": settings.controller.model_dump(mode="json"),
        "job": settings.job.model_dump(mode="json"),
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
    """Return where a search stood and the s that it had taken.

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
            loop=Loop(**head["loop"]),
        )
        return progress, float(head["seconds"])
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(path, f"is no checkpoint ({error!r})", "leave --resume out") from None


CHECKPOINT = "checkpoint.npz"
SECOND_CHECKPOINT = "checkpoint_hybrid.npz"
FAR_OFF = 3.0
"""Multiple of the noise beyond which a flight is not met well enough to be polished at once."""
AGREE = 0.01
"""Starts whose losses differ by less than this share have reached the same minimum."""
INSIDE = 0.02
"""Share of its range by which a start keeps away from a bound."""

OnProgress = Callable[[Job, Progress], None]


def search(
    job: Job,
    folder: Path,
    *,
    resume: bool,
    on_progress: OnProgress,
    findings: tuple[Finding, ...] = (),
    provisional: bool = False,
) -> Fitted:
    """Look for the best coefficients of a job.

    With the method ``auto``, least squares is followed by ``hybrid`` where its end is doubtful.

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
        Of the check before the search, to be handed on.
    provisional
        Whether to end before the polish where most flights are still far off: the model may lack
        something, and the search can be gone on with.

    Raises
    ------
    InputError
        There is no checkpoint to resume from, or it belongs to another job.
    """
    method = job.settings.job.search.method
    first = _Attempt(
        job,
        folder / CHECKPOINT,
        "gradient" if method == "auto" else method,
        on_progress,
        findings,
        provisional,
    )
    fitted = first.run(resume=resume)
    doubt = _doubt(job, fitted) if method == "auto" and fitted.polished else None
    if doubt is None:
        return fitted
    second = replace(first, checkpoint=folder / SECOND_CHECKPOINT, method="hybrid")
    rival = second.run(resume=resume and second.checkpoint.exists())
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


def _doubt(job: Job, fitted: Fitted) -> Finding | None:
    """Return why the end of least squares is doubtful, if it is."""
    losses = np.array([np.inf if end.loss is None else end.loss for end in fitted.outcomes])
    if len(losses) > 2 and (losses < (1.0 + AGREE) * losses.min()).sum() < 2:
        return Finding(Code.STARTS_DISAGREE, "info", "search", {"starts": len(losses)})
    lost = unmatched(fitted.scales)
    if all(INLETS[inlet].closed_loop for inlet in job.inlets) and len(lost) > len(job.fitted) / 2:
        numbers = {"far_off": len(lost), "flights": len(job.fitted)}
        return Finding(Code.FLIGHTS_FAR_OFF, "info", "search", numbers)
    return None


def _is_far_off(progress: Progress) -> bool:
    """Return whether most flights are met much worse than noise would have it, by some channel."""
    worst = np.max(list(progress.scales.values()), axis=0)
    return bool(np.median(worst) > FAR_OFF)


def _misfit(fitted: Fitted) -> float:
    """Return how far all channels of all flights are met, each by its own noise."""
    return float(np.mean([np.log(s) for scale in fitted.scales.values() for s in scale.values()]))


@dataclass(frozen=True)
class _Attempt:
    """One method's search, with its own checkpoint."""

    job: Job
    checkpoint: Path
    method: str
    on_progress: OnProgress
    findings: tuple[Finding, ...]
    provisional: bool

    def run(self, *, resume: bool) -> Fitted:
        """Run the method from the starts, or from where its checkpoint stands."""
        job, key = self.job, fingerprint(self.job)
        stages, starts = self._stages(), starting_vectors(job)
        free = Free(np.ones(len(job.space), bool), free_offsets(job))
        start, spent = beginning(job.objective, starts), 0.0
        progress = start
        if resume:
            progress, spent = load(self.checkpoint, key, start)
        began = time.perf_counter() - spent

        def on_progress(progress: Progress) -> None:
            seconds = time.perf_counter() - began
            save(self.checkpoint, key, progress, seconds)
            remaining = left(stages, progress.stage, progress.steps, seconds)
            self.on_progress(job, replace(progress, left=remaining))

        if job.windows is not None and not resume:
            progress = beginning(job.objective, _through_windows(job, starts, free))
        progress = grow(
            job.objective,
            stages,
            progress,
            free=free,
            undecided=job.undecided(job.objective),
            on_progress=on_progress,
            seed=job.settings.job.search.seed,
            worth_polishing=lambda progress: not (self.provisional and _is_far_off(progress)),
            start=start,
        )
        seconds = time.perf_counter() - began
        save(self.checkpoint, key, progress, seconds)
        fitted = self._fitted(stages[-1], progress, starts, seconds)
        return replace(fitted, polished=progress.stage == len(stages))

    def _stages(self) -> tuple[Stage, ...]:
        """Return the method's stages; flights that windows prepare are flown whole at once."""
        stages = stages_of(self.job, self.job.objective, self.method)
        if self.job.windows is None:
            return stages
        return tuple(stage for stage in stages if stage.horizon == self.job.objective.samples)

    def _fitted(
        self, stage: Stage, progress: Progress, starts: NDArray[np.float64], seconds: float
    ) -> Fitted:
        job, best = self.job, int(np.argmin(progress.losses))
        point = point_of(progress.points, best)
        objective = with_loop(job.objective, progress.loop)
        criterion = criterion_of(stage, progress.scales, np.asarray(point.offsets), progress.states)
        ends = zip(starts, progress.points.coefficients, progress.losses, strict=True)
        outcomes = tuple(
            Outcome(
                origin="random" if number else "vehicle file",
                loss=float(loss),
                start=job.space.numbers(start),
                end=job.space.numbers(end),
            )
            for number, (start, end, loss) in enumerate(ends)
        )
        fitted = Fitted(
            objective=objective,
            point=point,
            criterion=criterion,
            noise=job.noise,
            scales=by_flight(progress.scales, job.fitted),
            iterations=progress.iterations,
            outcomes=outcomes,
            method=self.method,
            evaluations=progress.evaluations,
            wall_time=seconds,
            loss_best=float(progress.losses[best]),
            converged=progress.converged,
        )
        return replace(fitted, findings=(*self.findings, *findings_at(job, fitted)))


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


def _through_windows(job: Job, starts: NDArray[np.float64], free: Free) -> NDArray[np.float64]:
    """Return where windows lead each start (S, K), for flights that do not begin gently."""
    assert job.windows is not None
    progress = grow(
        job.windows,
        stages_of(job, job.windows)[:-1],
        beginning(job.windows, starts),
        free=free,
        undecided=(),
        on_progress=lambda _: None,
    )
    return np.asarray(progress.points.coefficients)


def free_offsets(job: Job) -> NDArray[np.bool_]:
    """Return (offsets, N) which offsets of which flight are fitted.

    What enters below the reference does so on the flight controller's clock, which then is the
    simulation's own.
    """
    free = np.ones((len(job.objective.of_flight), len(job.fitted)), bool)
    free[: len(CLOCKS), list(job.offset_is_fixed)] = False
    fed = [not INLETS[inlet].closed_loop for inlet in job.inlets]
    free[CLOCKS.index("flight_controller"), fed] = False
    if job.objective.segments.windowed and job.objective.segments.freedom is None:
        free[: len(OFFSETS)] = False  # a recorded start has the recording's clock and bias
    return free


def parameters_of(job: Job, progress: Progress) -> Mapping[str, float]:
    """Return the best coefficients so far."""
    return job.space.numbers(progress.best_point.coefficients)


def starting_vectors(job: Job) -> NDArray[np.float64]:
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
    shares = np.clip(centre + drawn * reach, INSIDE, 1.0 - INSIDE)
    return np.vstack([first, space.at_share(shares)])

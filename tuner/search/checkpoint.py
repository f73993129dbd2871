"""A search on disk: written whole after every iteration, gone on with to the same numbers."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from tuner.core.disk import whole_file
from tuner.core.errors import InputError
from tuner.core.files import read_arrays
from tuner.objective.criterion import Point
from tuner.search.iteration import Iteration
from tuner.search.loop import Loop
from tuner.search.problem import Job
from tuner.search.progress import Progress


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
            points=Point(jnp.asarray(data["coefficients"]), jnp.asarray(data["offsets"])),
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

"""The fit once more, its flights counted differently: what folds and bootstrap have in common."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from tuner.core.errors import RecordingError
from tuner.engine import Report, current
from tuner.objective.normal import Objective
from tuner.search.estimation import free_offsets
from tuner.search.fitted import Fitted
from tuner.search.iteration import Iteration
from tuner.search.optimiser import Free
from tuner.search.polish import polished
from tuner.search.problem import Job

T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True)
class Whole:
    """What all refits start from: the job, and the fit to all of its flights."""

    job: Job
    fitted: Fitted


def check_flights(job: Job, option: str, what: str) -> None:
    """Refuse a job that has a single flight.

    Raises
    ------
    RecordingError
        There are fewer than two flights to fit.
    """
    if len(job.fitted) < 2:
        raise RecordingError(option, what, "give two or more")


def refitted(whole: Whole, counts: ArrayLike, title: str, report: Report) -> Fitted:
    """Return the fit polished again, each flight counted so many times.

    A flight that counts for nothing keeps its place with weights of zero, so that nothing compiles
    again.

    Parameters
    ----------
    whole
        The fit to begin at.
    counts
        (F,) how often each fitted flight counts.
    title
        What stands before the stages' names in messages.
    report
        Gets every iteration.
    """
    job, fitted = whole.job, whole.fitted
    held = set(fitted.held.values())
    return polished(
        job,
        replace(fitted, objective=_counted(fitted.objective, np.asarray(counts, float))),
        free=Free(np.array([name not in held for name in job.space.names]), free_offsets(job)),
        title=title,
        on_progress=lambda progress: report(progress.iterations[-1].model_dump()),
    )


def _counted(objective: Objective, counts: NDArray[np.float64]) -> Objective:
    """Return an objective to which each flight contributes so many times."""
    others = jnp.asarray(counts > 0.0)[jnp.asarray(objective.segments.flight)]
    changed: Objective = eqx.tree_at(
        lambda o: [measured.weight for measured in o.segments.measured.values()],
        objective,
        [measured.weight * others for measured in objective.segments.measured.values()],
    )
    if counts.max() <= 1.0:
        return changed
    return replace(changed, multiplicity=jnp.asarray(counts))


def in_engine(
    function: Callable[[tuple[Callable[[], Whole], T], Report], R],
    job: Job,
    fitted: Fitted,
    tasks: Sequence[T],
    on_iteration: Callable[[Iteration], None],
) -> list[R]:
    """Have the engine in force compute refits.

    Parameters
    ----------
    function
        Of a module; takes what gives the `Whole`, and a task. Reports iterations.
    job, fitted
        What all refits start from.
    tasks
        What each refit is.
    on_iteration
        Gets the iterations; of refits side by side, the last of each stage.
    """
    engine, last = current(), dict[int, Iteration]()

    def heard(number: int, report: dict[str, Any]) -> None:
        before, last[number] = last.get(number), Iteration(**report)
        if engine.at_once == 1:
            on_iteration(last[number])
        elif before is not None and before.stage != last[number].stage:
            on_iteration(before)

    whole = engine.share(Whole(job, fitted))
    found = engine.map(function, [(whole, task) for task in tasks], heard)
    if engine.at_once > 1:
        for iteration in last.values():
            on_iteration(iteration)
    return found


def coefficients_of(refits: Sequence[Mapping[str, float]]) -> dict[str, NDArray[np.float64]]:
    """Return coefficient -> its value in each refit."""
    return {name: np.array([refit[name] for refit in refits]) for name in refits[0]}

"""What the flights cannot tell is held where the user had it, and the rest fitted around it.

Coefficients that trade off exactly keep their product right however far they wander. Setting each
back to its start would break what the fit found; so one of every such group is set back, and the
others follow.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from tuner.coefficients import COEFFICIENTS
from tuner.examination.examination import Examination, examine
from tuner.job.polish import polished
from tuner.job.prepare import Job
from tuner.job.search import free_offsets
from tuner.objective.criterion import Point
from tuner.search.fitted import Fitted
from tuner.search.optimiser import Free
from tuner.search.progress import Progress
from tuner.uncertainty.estimates import Uncertainty

MOST_ROUNDS = 3
"""What is held may leave something else undetermined; this often, at most."""


def with_undetermined_held(
    job: Job,
    fitted: Fitted,
    tell: Callable[[Job, Progress], None],
    message: Callable[[str], None],
) -> tuple[Fitted, Examination]:
    """Return the fit once all that it leaves open is held, and what its end says."""
    examination = examine(fitted)
    for _ in range(MOST_ROUNDS):
        held = held_by(examination.uncertainty) | dict(fitted.held)
        names = sorted(set(held.values()))
        if set(names) <= set(fitted.held.values()):
            break
        message(f"the flights do not tell {', '.join(names)}: kept as given")
        fitted = hold(job, fitted, held, tell)
        examination = examine(fitted)
    return fitted, examination


def held_by(uncertainty: Uncertainty) -> dict[str, str]:
    """Return each coefficient that the flights do not tell -> the one held in its place.

    A coefficient is held itself unless it trades off against one that is.
    """
    open_ones = [name for name in uncertainty.names if not uncertainty.estimates[name].identifiable]
    held: dict[str, str] = {}
    for direction in uncertainty.directions:
        members = [name for name in direction.moves if name in open_ones and name not in held]
        if not direction.null or len(members) < 2:
            continue
        ranked = sorted(members, key=lambda name: _rank(name, direction.moves))
        held |= dict.fromkeys(members, ranked[0])
    return held | {name: name for name in open_ones if name not in held}


def _rank(name: str, moves: Mapping[str, float]) -> tuple[float, float]:
    rank = COEFFICIENTS[name].hold_rank
    return math.inf if rank is None else rank, -abs(moves[name])


def hold(
    job: Job,
    fitted: Fitted,
    held: Mapping[str, str],
    tell: Callable[[Job, Progress], None],
) -> Fitted:
    """Return the fit with the held coefficients at their initial values and the others polished.

    Parameters
    ----------
    job, fitted
        The problem and where its search ended.
    held
        As of `held_by`; what stands on the left but not on the right stays free.
    tell
        Called after every iteration.
    """
    names, space = set(held.values()), job.space
    keeps = np.array([name in names for name in space.names])
    if not keeps.any():
        return fitted
    clock = time.perf_counter()
    vector = np.where(keeps, space.initial, np.asarray(fitted.point.coefficients))
    free = Free(~keeps, free_offsets(job))
    point = Point(jnp.asarray(vector), fitted.point.offsets)
    end = polished(
        job,
        replace(fitted, point=point),
        free=free,
        title=f"with {len(names)} held",
        on_progress=lambda now: tell(job, now),
    )
    return replace(end, held=dict(held), wall_time=fitted.wall_time + time.perf_counter() - clock)

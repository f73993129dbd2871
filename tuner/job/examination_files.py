"""Files that a fit and `tune sensitivity` both write: what is known, and what to fly next."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sim_jax.inlet import ReferenceInlet
from tuner.design.proposals import Proposals
from tuner.design.ranking import CLEARANCE, LEVEL, SMALLEST, Arena, rank_next_flights
from tuner.recordings.flight import Flight
from tuner.search.fitted import Fitted
from tuner.search.problem import SPIN_CHANNELS, Job
from tuner.uncertainty.examination import Examination, knowledge_of
from tuner.uncertainty.sensitivity_json import Knowledge, write_files

MARGIN = 1.0
"""Length added to what the recorded flights took, to make an arena of it; m."""
SHORTEST = 20.0
"""Length of a proposed flight, or twice, four times as long, whichever is nearest to the recorded
ones, for each length is compiled anew; s. The publisher takes ten to wind up."""


def write_knowledge(folder: Path, job: Job, examination: Examination, fitted: Fitted) -> Knowledge:
    """Write what is known of each coefficient into a result folder, and return it."""
    knowledge = knowledge_of(examination, job.space, fitted.point)
    write_files(knowledge, folder)
    return knowledge


def write_next_flight(
    folder: Path, job: Job, examination: Examination, fitted: Fitted, arena: Arena | None = None
) -> Proposals | None:
    """Write what to fly next into a result folder, and return it.

    Returns None, and writes nothing, where the controllers that flew are not simulated.

    Parameters
    ----------
    folder
        The result folder.
    job, examination, fitted
        The recorded flights, what they identify, and the fit.
    arena
        Where the next flight must fit; None takes what the recorded flights took, and some more.
    """
    if not isinstance(examination.full_problem.objective.segments.inlet, ReferenceInlet):
        return None
    seconds = float(np.median([flight.duration for flight in job.fitted]))
    doublings = max(round(float(np.log2(seconds / SHORTEST))), 0)
    proposals = rank_next_flights(
        examination,
        fitted.criterion,
        arena=arena_of(job.flights) if arena is None else arena,
        seconds=round(SHORTEST * 2**doublings),
        spin_channels=SPIN_CHANNELS,
    )
    proposals.write(folder)
    return proposals


def arena_of(flights: Sequence[Flight]) -> Arena:
    """Return the box about the origin that some flights took, and a little more."""
    places = np.concatenate([flight.series["position"].values for flight in flights])
    x, y = (2.0 * float(np.nanmax(np.abs(places[:, axis]))) for axis in (0, 1))
    top = float(np.nanmax(places[:, 2]))
    least = 2.0 * CLEARANCE + 2.0 * SMALLEST
    return Arena(
        x=round(max(x + MARGIN, least), 1),
        y=round(max(y + MARGIN, least), 1),
        z=round(max(top + MARGIN, LEVEL + CLEARANCE), 1),
    )

"""The terms that are free from the beginning of a search: those named, and those seen in hover.

A steady hover in still air is level, whatever hovers. Where all recordings say otherwise the
markers sit at an angle; left out, a degree of it tilts every thrust by 2 % of the weight and
swamps whatever else the model lacks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tuner.objective.battery import require_voltage
from tuner.objective.inlets import INLETS
from tuner.objective.space import extended
from tuner.objective.start import rests
from tuner.recordings.flight import Flight
from tuner.search.problem import Job
from tuner.terms.candidates import candidate_groups, groups_named, start_of

MARKERS = ("marker_offset", "marker_tilt")
"""The groups of the motion capture's frame."""
LEVEL = 3e-3
"""rad of tilt in hover below which markers are not freed for it."""
SURE = 3.0
"""Standard errors, over the flights, by which the tilt exceeds zero."""


def with_first_terms(job: Job) -> Job:
    """Return the job with the terms free that its search begins with.

    Raises
    ------
    RecordingError
        A term needs the battery's voltage, and a flight has none.
    """
    settings = job.settings.job
    tilt = hover_tilt(job.fitted)
    if not isinstance(settings.terms, str):
        groups = groups_named(settings.terms, job.space)
    elif settings.terms == "auto" and settings.free is None and _tilted(job, tilt):
        candidates = candidate_groups(job.settings.vehicle, job.space, settings)
        groups = {name: candidates[name] for name in MARKERS if name in candidates}
    else:
        groups = {}
    names = [name for group in groups.values() for name in group]
    if not names:
        return job
    if "battery_exponent" in names:
        require_voltage(job.fitted)
    begin = dict(zip(("marker_tilt_x", "marker_tilt_y"), tilt.mean(axis=0), strict=True))
    values = {name: float(begin.get(name, value)) for name, value in start_of(names).items()}
    space = extended(job.space, names, settings, values)
    windows = None if job.windows is None else replace(job.windows, space=space)
    return replace(
        job,
        space=space,
        objective=replace(job.objective, space=space),
        windows=windows,
        first_terms=groups,
    )


def hover_tilt(flights: Sequence[Flight]) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Return the recorded tilt about x and y, (n, 2) rad, of the flights that begin in hover.

    One row of zeros where none does.
    """
    attitudes = [flight.initial.attitude for flight in flights if rests(flight.initial)]
    # for an attitude Rz(heading)·tilt, the world's z axis in the body is that of the tilt alone
    tilts = [(2.0 * (w * x + y * z), 2.0 * (w * y - x * z)) for w, x, y, z in attitudes]
    return np.array(tilts or [(0.0, 0.0)])


def _tilted(job: Job, tilt: np.ndarray[tuple[int, int], np.dtype[np.float64]]) -> bool:
    """Return whether the flights of a closed loop agree that their hover is not level."""
    closed = all(INLETS[inlet].closed_loop for inlet in job.inlets)
    if not closed or len(tilt) < 2:
        return False
    mean = np.abs(tilt.mean(axis=0))
    error = tilt.std(axis=0, ddof=1) / np.sqrt(len(tilt))
    return bool(((mean > LEVEL) & (mean > SURE * error)).any())

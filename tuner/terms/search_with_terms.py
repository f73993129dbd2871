"""The search of a job together with the selection of its terms, and the terms it begins with."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from tuner.core.phrases import listed
from tuner.core.spans import span
from tuner.evaluate.validation import point_estimates
from tuner.findings.findings import Finding
from tuner.objective.battery import require_voltage
from tuner.objective.information import are_refuting
from tuner.objective.initial_conditions import rests
from tuner.objective.inlets import INLETS
from tuner.objective.space import extended
from tuner.recordings.flight import Flight
from tuner.search.estimation import OnProgress, search
from tuner.search.iteration import PointEstimate
from tuner.search.problem import Job
from tuner.search.progress import Fitted
from tuner.terms.candidates import Selected, candidate_groups, groups_around, groups_named, start_of
from tuner.terms.selection import Selection
from tuner.uncertainty.model_error import GAINS, gain_told, gains_far_off, lack_of
from tuner.vehicle import COEFFICIENTS
from tuner.vehicle.selection_table import Groups, SelectionCode

MARKERS = ("marker_offset", "marker_tilt")
"""The groups of the motion capture's frame."""
LEAST_TILT = 3e-3
"""rad of tilt in hover below which markers are not freed for it."""
SIGNIFICANT = 3.0
"""Standard errors, over the flights, by which the tilt exceeds zero."""
SAME_GAIN = 0.02
"""Share of a gain within which it is the file's."""
FILES_GAINS = "Recorded commands have the file's gains: fitting again without {}."


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
        candidates = candidate_groups(job)
        groups = {name: candidates[name] for name in MARKERS if name in candidates}
    else:
        groups = {}
    names = [name for group in groups.values() for name in group]
    if not names:
        return job
    if "battery_exponent" in names:
        require_voltage(job.fitted)
    begin = dict(zip(("marker_tilt_x", "marker_tilt_y"), tilt.mean(axis=0), strict=True))
    begin |= {name: row.begin for name in names if (row := COEFFICIENTS[name]).begin is not None}
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
    return bool(((mean > LEAST_TILT) & (mean > SIGNIFICANT * error)).any())


def search_with_terms(
    job: Job,
    folder: Path,
    *,
    resume: bool,
    on_progress: OnProgress,
    on_message: Callable[[str], None],
    on_estimates: Callable[[Sequence[PointEstimate]], None] = lambda _: None,
    on_doubt: Callable[[Finding], None] = lambda _: None,
    findings: tuple[Finding, ...] = (),
) -> Selected:
    """Look for the best coefficients of a job, and for the terms that its flights call for.

    Where most flights are far off, terms are tried before the base model is polished, and before
    CMA-ES looks for another beginning; where flights contradict the fit, none is. Arguments and
    errors are those of `search`; between the two, ``on_estimates`` gets where it ended, or, if it
    has stopped because the model is far off, ``on_doubt`` what recorded commands say of gains.
    """

    def searched(*, resume: bool, provisional: bool) -> Selected:
        with span("search"):
            fitted = search(
                job,
                folder,
                resume=resume,
                on_progress=on_progress,
                findings=findings,
                provisional=provisional,
            )
        if fitted.polished:
            on_estimates(point_estimates(job, fitted))
        if _is_refuted(fitted):
            return Selected(job, fitted, refuted=True)
        if not fitted.polished:
            for finding in gains_far_off(fitted, job.fitted):
                on_doubt(finding)
        with span("selection of terms"):
            selected = with_terms_selected(job, fitted, on_progress, on_message)
        return replace(selected, refuted=_is_refuted(selected.fitted))

    selected = searched(resume=resume, provisional=bool(candidates_of(job)))
    if selected.fitted.polished:
        return selected
    return searched(resume=True, provisional=False)


def _is_refuted(fitted: Fitted) -> bool:
    if fitted.residuals_at_noise_level:
        return False
    return are_refuting(fitted.objective, fitted.point, fitted.criterion)


def with_terms_selected(
    job: Job, fitted: Fitted, on_progress: OnProgress, on_message: Callable[[str], None]
) -> Selected:
    """Return the fit with the terms that the job names, or that the flights speak for.

    A job that says exactly what is free names no others, unless its ``terms`` do.
    """
    clock, candidates = time.perf_counter(), candidates_of(job)
    selection = Selection(job, fitted, candidates, on_progress, on_message)
    if not isinstance(job.settings.job.terms, str):
        selected = Selected(job, fitted, selection.rows_of_named())
    elif candidates:
        selected = selection.run()
        if refuted := refuted_by_commands(selected, selected.fitted):
            on_message(FILES_GAINS.format(listed(refuted)))
            left = {name: names for name, names in candidates.items() if name not in refuted}
            gone = [row for row in with_refuted(selected, refuted).rows if row.group in refuted]
            without = replace(selection, candidates=left).run()
            selected = replace(without, rows=(*without.rows, *gone))
    else:
        rows = () if job.accelerations is None else job.accelerations.rows
        selected = Selected(job, fitted, rows)
    spent = time.perf_counter() - clock
    return replace(selected, fitted=replace(selected.fitted, wall_time=fitted.wall_time + spent))


def refuted_by_commands(selected: Selected, fitted: Fitted) -> tuple[str, ...]:
    """Return the groups of gains in a selection's fit that recorded commands take back.

    Simulated flights tell gains by all that a loop does, and may want others for what the model
    lacks; how recorded commands answer the recorded rates says them by itself.
    """
    kept = {row.group: row.names for row in selected.rows if row.kept and row.names[0] in GAINS}
    if not kept or (lack := lack_of(fitted, selected.job.fitted)) is None:
        return ()
    numbers = fitted.objective.space.numbers(fitted.point.coefficients)

    def are_files(name: str) -> bool:
        told = gain_told(name, lack.answers)
        return told is not None and abs(numbers[name] * told[0] - 1.0) < SAME_GAIN

    return tuple(group for group, names in kept.items() if any(map(are_files, names)))


def with_refuted(selected: Selected, groups: Collection[str]) -> Selected:
    """Return a selection whose table says that recorded commands refute some groups."""
    found = {"kept": False, "reason": SelectionCode.REFUTED}
    rows = (row.model_copy(update=found if row.group in groups else {}) for row in selected.rows)
    return replace(selected, rows=tuple(rows))


def candidates_of(job: Job) -> Groups:
    """Return the groups among which a job's flights choose: none where it says what is free."""
    settings = job.settings.job
    if settings.terms != "auto" or settings.free is not None:
        return {}
    closed = all(INLETS[inlet].closed_loop for inlet in job.inlets)
    return {
        **candidate_groups(job),
        **groups_around(job.objective, closed_loop=closed),
    }

"""The search of a job together with the selection of its terms, and the terms it begins with."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from tuner.core.numerics import Array
from tuner.core.phrases import listed
from tuner.core.spans import span
from tuner.evaluate.validation import point_estimates
from tuner.findings.findings import Finding
from tuner.objective.battery import require_voltage
from tuner.objective.information import is_refuted
from tuner.objective.initial_conditions import is_at_rest
from tuner.objective.inlets import INLETS
from tuner.objective.space import extended
from tuner.recordings.flight import Flight
from tuner.search.estimation import OnProgress, search
from tuner.search.iteration import PointEstimate
from tuner.search.problem import Job
from tuner.search.progress import Fitted
from tuner.terms.candidates import (
    Selected,
    candidate_groups,
    condition_groups,
    groups_named,
    neutral_values,
)
from tuner.terms.selection import Selection
from tuner.uncertainty.model_error import (
    GAIN_AXES,
    gain_by_commands,
    gains_far_off,
    model_errors_of,
)
from tuner.vehicle import COEFFICIENTS
from tuner.vehicle.selection_table import Groups, SelectionCode

MARKER_GROUPS = ("marker_offset", "marker_tilt")
"""The groups of the motion capture's frame."""
MIN_HOVER_TILT_RAD = 3e-3
"""Least mean tilt in hover, rad, that frees the markers' frame."""
MIN_TILT_SE = 3.0
"""Standard errors over the flights by which the mean tilt must exceed zero."""
GAIN_TOLERANCE = 0.02
"""Relative difference below which a gain counts as the controller file's."""
GAINS_REFUTED = "Recorded commands have the file's gains: fitting again without {}."


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
    elif settings.terms == "auto" and settings.free is None and _hovers_tilted(job, tilt):
        candidates = candidate_groups(job)
        groups = {name: candidates[name] for name in MARKER_GROUPS if name in candidates}
    else:
        groups = {}
    names = [name for group in groups.values() for name in group]
    if not names:
        return job
    if "battery_exponent" in names:
        require_voltage(job.fitted)
    begin = dict(zip(("marker_tilt_x", "marker_tilt_y"), tilt.mean(axis=0), strict=True))
    begin |= {name: row.begin for name in names if (row := COEFFICIENTS[name]).begin is not None}
    values = {name: float(begin.get(name, value)) for name, value in neutral_values(names).items()}
    space = extended(job.space, names, settings, values)
    windows = None if job.windows is None else replace(job.windows, space=space)
    return replace(
        job,
        space=space,
        objective=replace(job.objective, space=space),
        windows=windows,
        first_terms=groups,
    )


def hover_tilt(flights: Sequence[Flight]) -> Array:
    """Return the recorded tilt about x and y, (n, 2) rad, of the flights that begin in hover.

    One row of zeros where none does.
    """
    attitudes = [flight.initial.attitude for flight in flights if is_at_rest(flight.initial)]
    # for an attitude Rz(heading)·tilt, the world's z axis in the body is that of the tilt alone
    tilts = [(2.0 * (w * x + y * z), 2.0 * (w * y - x * z)) for w, x, y, z in attitudes]
    return np.array(tilts or [(0.0, 0.0)])


def _hovers_tilted(job: Job, tilt: Array) -> bool:
    """Return whether the flights of a closed loop agree that their hover is not level."""
    closed = all(INLETS[inlet].closed_loop for inlet in job.inlets)
    if not closed or len(tilt) < 2:
        return False
    mean = np.abs(tilt.mean(axis=0))
    error = tilt.std(axis=0, ddof=1) / np.sqrt(len(tilt))
    return bool(((mean > MIN_HOVER_TILT_RAD) & (mean > MIN_TILT_SE * error)).any())


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
    CMA-ES looks for another start; where flights contradict the fit, none is. Arguments and errors
    are those of `search`. Before terms are tried, ``on_estimates`` gets the search's estimates; if
    the search stopped early, ``on_doubt`` gets findings about gains from recorded commands.
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
    return is_refuted(fitted.objective, fitted.point, fitted.criterion)


def with_terms_selected(
    job: Job, fitted: Fitted, on_progress: OnProgress, on_message: Callable[[str], None]
) -> Selected:
    """Return the fit with the terms that the job names, or that the flights select.

    A job with a ``free`` list selects none, unless ``terms`` names some.
    """
    clock, candidates = time.perf_counter(), candidates_of(job)
    selection = Selection(job, fitted, candidates, on_progress, on_message)
    if not isinstance(job.settings.job.terms, str):
        selected = Selected(job, fitted, selection.rows_of_named())
    elif candidates:
        selected = selection.run()
        if refuted := refuted_by_commands(selected, selected.fitted):
            on_message(GAINS_REFUTED.format(listed(refuted)))
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
    """Return the groups of fitted gains that recorded commands refute.

    In a closed-loop simulation wrong gains may make up for model errors; the regression of recorded
    commands on recorded rates estimates the gains by themselves.
    """
    kept = {row.group: row.names for row in selected.rows if row.kept and row.names[0] in GAIN_AXES}
    if not kept or (model_errors := model_errors_of(fitted, selected.job.fitted)) is None:
        return ()
    numbers = fitted.objective.space.numbers(fitted.point.coefficients)

    def matches_file(name: str) -> bool:
        gain = gain_by_commands(name, model_errors.controller)
        return gain is not None and abs(numbers[name] * gain[0] - 1.0) < GAIN_TOLERANCE

    return tuple(group for group, names in kept.items() if any(map(matches_file, names)))


def with_refuted(selected: Selected, groups: Collection[str]) -> Selected:
    """Return a selection with some groups marked as refuted by recorded commands."""
    found = {"kept": False, "reason": SelectionCode.REFUTED}
    rows = (row.model_copy(update=found if row.group in groups else {}) for row in selected.rows)
    return replace(selected, rows=tuple(rows))


def candidates_of(job: Job) -> Groups:
    """Return the groups to select from; none where the job has a ``free`` list."""
    settings = job.settings.job
    if settings.terms != "auto" or settings.free is not None:
        return {}
    closed = all(INLETS[inlet].closed_loop for inlet in job.inlets)
    return {**candidate_groups(job), **condition_groups(job.objective, closed_loop=closed)}

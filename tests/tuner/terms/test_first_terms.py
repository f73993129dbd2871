"""Terms that a search begins with: those that a job names, and markers that hover at an angle."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from tests.tuner.terms.making import BASE, hovering, unfitted_with
from tuner.config import JobFile
from tuner.search.listener import Reporter
from tuner.terms.candidates import with_terms
from tuner.terms.selection import hover_tilt, with_first_terms, with_terms_selected
from tuner.vehicle.selection_table import SelectionCode

MARKERS = {f"marker_{kind}_{axis}" for kind in ("offset", "tilt") for axis in "xyz"}
TILT = (0.010, -0.016)


class FlightWith:
    def __init__(self, initial):
        self.initial = initial


@pytest.mark.parametrize("heading", [0.0, 1.0, -3.0])
def test_the_tilt_is_read_whatever_the_heading(heading):
    tilt = hover_tilt([FlightWith(hovering(TILT, heading))])
    np.testing.assert_allclose(tilt, [TILT], atol=1e-4)
    assert not hover_tilt([]).any()


def with_file(job, file):
    return replace(job, settings=SimpleNamespace(job=file, vehicle=job.settings.vehicle))


@pytest.fixture(scope="module")
def jobs():
    return {tilt: unfitted_with(0.0, seed=0, tilt=tilt) for tilt in (TILT, (0.0, 0.001))}


def test_markers_are_free_from_the_start_where_hover_is_not_level(jobs):
    job, _ = jobs[TILT]
    begun = with_first_terms(job)
    assert set(begun.space.names) == {*BASE, *MARKERS}
    start = begun.space.numbers(begun.space.initial)
    assert (start["marker_tilt_x"], start["marker_tilt_y"]) == pytest.approx(TILT, abs=1e-4)


def test_a_level_hover_and_a_job_without_terms_add_nothing(jobs):
    level, _ = jobs[(0.0, 0.001)]
    assert with_first_terms(level) is level
    tilted, _ = jobs[TILT]
    for file in (JobFile(terms="none"), JobFile(free=BASE)):
        job = with_file(tilted, file)
        assert with_first_terms(job) is job


def test_named_terms_are_free_from_the_start_and_stand_in_the_table(jobs):
    job, fitted = jobs[(0.0, 0.001)]
    file = JobFile(terms=("fuselage_drag", "marker_tilt"))
    begun = with_first_terms(with_file(job, file))
    assert begun.space.names[-4:] == (
        "fuselage_drag",
        "marker_tilt_x",
        "marker_tilt_y",
        "marker_tilt_z",
    )
    fitted = with_free(fitted, begun.space.names[-4:], file)
    rows = with_terms_selected(begun, fitted, Reporter()).rows
    assert [(row.group, row.kept, row.reason) for row in rows] == [
        ("fuselage_drag", True, SelectionCode.ASKED_FOR),
        ("marker_tilt", True, SelectionCode.ASKED_FOR),
    ]


def with_free(fitted, names, file):
    """Return a fit in a space that is wider by some terms, at their neutral values."""
    objective, point = with_terms(fitted.objective, fitted.point, names, file)
    return replace(fitted, objective=objective, point=point)


def test_a_named_term_has_a_row_with_its_gain(jobs):
    """On flights that know nothing of it as on flights through a drag of 0.05."""
    file, worth = JobFile(terms=("fuselage_drag",)), []
    for job, fitted in (jobs[(0.0, 0.001)], unfitted_with(0.05, seed=0, tilt=(0.0, 0.001))):
        begun = with_first_terms(with_file(job, file))
        there = with_free(fitted, ("fuselage_drag",), file)
        (row,) = with_terms_selected(begun, there, Reporter()).rows
        worth.append((row.gain_fit, row.gain_holdout, row.scatter))
    (fit, held_out, scatter), (fit_there, held_out_there, scatter_there) = worth
    assert abs(fit) < 0.02
    assert abs(held_out) < 3.0 * scatter
    assert fit_there > 0.2
    assert held_out_there > 2.0 * scatter_there

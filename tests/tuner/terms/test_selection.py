"""The whole selection on short simulated flights whose truth holds a term, or does not."""

from types import SimpleNamespace

import numpy as np
import pytest

from tests.tuner.terms.making import BASE, job_with, unfitted_with
from tuner.config import JobFile
from tuner.objective.criterion import units_of
from tuner.report.result_texts import selection_in_words
from tuner.search.listener import Listener, Reporter
from tuner.terms import selection
from tuner.terms import selection as terms
from tuner.terms.linearisation import LinearisedFit
from tuner.terms.score import Score
from tuner.terms.selection import with_terms_selected
from tuner.uncertainty.estimates import uncertainty_of
from tuner.uncertainty.examination import examine
from tuner.vehicle import term_groups
from tuner.vehicle.selection_table import SelectionCode

DRAG = 0.03
LINEAR = "linear_drag"
BLIND = SimpleNamespace(columns_of=lambda _: ())


def selected(drag, *, seed=0, job=None, around=None):
    messages = []
    result = with_terms_selected(
        *job_with(drag, seed=seed, job=job, around=around),
        Reporter(Listener(on_message=messages.append)),
    )
    return result, messages


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize(
    ("group", "around"),
    [
        ("wind", {"wind_x": (0.25, -0.2), "wind_y": (0.2, 0.25)}),
        ("battery_decline", {"battery_decline": (0.004, 0.006)}),
    ],
)
def test_conditions_of_each_flight_are_selected_and_estimated(monkeypatch, group, around):
    """Among what may surround a flight alone, which makes it cheap."""
    monkeypatch.setattr(terms, "candidate_groups", lambda *_: {})
    result, _ = selected(0.0, around=around)
    row, *others = result.rows
    assert (row.group, row.kept, row.names) == (group, True, tuple(around))
    assert not any(other.kept for other in others)
    assert result.job.space.names == BASE_IN_ORDER
    assert result.job.objective.conditions == tuple(around)
    found = conditions_of_point(result.fitted)
    for name, values in around.items():
        assert found[name] == pytest.approx(values, abs=0.05 * max(map(abs, values)))


def conditions_of_point(fitted):
    names = fitted.objective.conditions
    rows = np.asarray(fitted.point.offsets)[-len(names) :] * units_of(names)[:, None]
    return dict(zip(names, rows, strict=True))


@pytest.mark.long
@pytest.mark.slow
def test_a_term_that_was_flown_is_found_and_its_interval_holds_the_truth():
    result, messages = selected(DRAG)
    row, *others = result.rows
    assert (row.group, row.kept) == ("fuselage_drag", True)
    assert not any(other.kept for other in others)
    assert row.gain_fit > 0.3
    assert result.job.space.names == (*BASE_IN_ORDER, "fuselage_drag")
    low, high = uncertainty_of(result.fitted).estimates["fuselage_drag"].ci95
    assert low < DRAG < high
    assert messages[0].startswith("The flights call for more than the base model")


@pytest.mark.long
@pytest.mark.slow
def test_a_small_term_that_sections_of_flights_predict_is_found():
    """Of a fifth of the drag two flights of six seconds show too little to predict each other."""
    result, _ = selected(DRAG / 5.0, seed=4)
    (row,) = (row for row in result.rows if row.kept)
    assert (row.group, row.reason) == ("fuselage_drag", SelectionCode.PREDICTS_SECTIONS)
    truth = result.job.space.numbers(result.job.space.initial) | {"fuselage_drag": DRAG / 5.0}
    known = examine(result.fitted, selection_shifts=result.selection_shifts).uncertainty.estimates
    for name in (*BASE_IN_ORDER, "fuselage_drag"):
        low, high = known[name].ci95
        assert low < float(truth[name]) < high, name


@pytest.mark.long
@pytest.mark.slow
def test_no_term_is_added_to_flights_that_lack_none():
    for seed in range(6):
        result, messages = selected(0.0, seed=seed)
        assert result.rows
        assert not any(row.kept for row in result.rows), seed
        assert result.job.space.names == BASE_IN_ORDER, seed
        assert not messages, seed


@pytest.mark.slow
@pytest.mark.long
def test_a_term_that_does_not_predict_flights_left_out_once_refitted_is_dropped(monkeypatch):
    monkeypatch.setattr(selection.Selection, "_predicts_better", lambda *_, **__: False)
    result, _ = selected(DRAG)
    assert not any(row.kept for row in result.rows)
    reasons = {row.group: row.reason for row in result.rows}
    assert reasons["fuselage_drag"] is SelectionCode.WORSE_AFTER_REFIT
    space = result.job.space
    assert space.names == BASE_IN_ORDER
    # what it would have changed is known all the same, and covers what its absence spoiled
    ends = [np.asarray(space.scaled(v)) for v in (result.fitted.point.coefficients, space.initial)]
    wrong = np.abs(ends[0] - ends[1])
    doubt = np.array([result.selection_shifts[name] for name in space.names])
    covariance = uncertainty_of(result.fitted).covariance
    known = covariance.error
    assert np.any(wrong > 1.96 * known / covariance.beyond_noise)  # what noise would say
    assert np.all(wrong < 1.96 * np.maximum(doubt, known)), (wrong, doubt, known)


def test_of_all_groups_only_the_battery_is_judged_as_one_that_a_recorded_signal_drives(
    monkeypatch,
):
    judged = []

    def backward_elimination(*_, excluding_gusts, **__):
        judged.extend(excluding_gusts)
        return {}, {}

    monkeypatch.setattr(selection, "backward_elimination", backward_elimination)
    groups = {**term_groups(), "wind": ("wind_x", "wind_y")}
    job = SimpleNamespace(space=SimpleNamespace(names=BASE_IN_ORDER))
    standing = LinearisedFit(SimpleNamespace(residuals_at_noise_level=False), groups, BLIND)
    selection.Selection(job, None, groups, Reporter())._pruned(standing)
    assert judged == ["battery"]


@pytest.mark.parametrize(
    ("reason", "tried"),
    [
        (SelectionCode.NOT_PREDICTED, True),
        (SelectionCode.PREDICTS_FLIGHTS, True),
        (SelectionCode.NOT_SIGNIFICANT, False),
        (SelectionCode.IMMATERIAL, False),
    ],
)
def test_all_terms_are_tried_where_one_gains_even_if_none_predicts_flights(
    monkeypatch, reason, tried
):
    """The base fit of a vehicle that lacks several lies anywhere."""
    searched, own = [], selection.Selection
    fitted = SimpleNamespace(residuals_at_noise_level=False, point=None, objective=None)
    standing = LinearisedFit(fitted, {}, None)
    monkeypatch.setattr(own, "_score", lambda *_: Score(0.4, 0.3, 0.1, 0.5, reason))
    monkeypatch.setattr(own, "linearised", lambda *_: standing)
    monkeypatch.setattr(own, "_with_all", lambda *_: searched.append(True))
    monkeypatch.setattr(own, "_with_added", lambda *_: standing)
    monkeypatch.setattr(own, "_rows", lambda *_: ())
    monkeypatch.setattr(own, "_with_doubts", lambda *given: given[-1])
    monkeypatch.setattr(selection, "with_groups", lambda base, *_, **__: base)
    groups = {"fuselage_drag": ("fuselage_drag",)}
    own(SimpleNamespace(), fitted, groups, Reporter()).run()
    assert bool(searched) is tried


def test_eliminated_groups_are_not_tried_again(monkeypatch):
    own, wanted = selection.Selection, []
    fitted = SimpleNamespace(residuals_at_noise_level=False, point=None, objective=None)
    standing = LinearisedFit(fitted, {}, None)
    score = Score(0.4, 0.3, 0.1, 0.0, SelectionCode.PREDICTS_FLIGHTS)
    rows = []
    monkeypatch.setattr(own, "_score", lambda *_: score)
    monkeypatch.setattr(own, "linearised", lambda *_: standing)
    monkeypatch.setattr(own, "_with_all", lambda *_: standing)
    monkeypatch.setattr(
        own, "_with_added", lambda _, __, groups, ___: wanted.extend(groups) or standing
    )
    monkeypatch.setattr(own, "_rows", lambda _, __, dropped: rows.extend(dropped) or ())
    monkeypatch.setattr(own, "_with_doubts", lambda *given: given[-1])
    groups = {"fuselage_drag": ("fuselage_drag",), "linear_drag": ("linear_drag_x",)}
    own(SimpleNamespace(), fitted, groups, Reporter()).run()
    assert wanted == ["linear_drag"]
    assert rows == ["fuselage_drag"]


@pytest.mark.slow
def test_terms_free_from_the_beginning_are_in_the_table_with_their_gain(
    monkeypatch,
):
    worth = Score(0.4, 0.3, 0.1, 0.5, SelectionCode.NOT_SIGNIFICANT)
    monkeypatch.setattr(selection, "score", lambda *_, **__: worth)
    drag, tilt = (tuple(f"{name}_{axis}" for axis in "xyz") for name in (LINEAR, "marker_tilt"))
    names = (*BASE_IN_ORDER, *drag, *tilt, "angular_drag_x")
    job = SimpleNamespace(
        space=SimpleNamespace(names=names, free=names), first_terms={"marker_tilt": tilt}
    )
    standing = LinearisedFit(SimpleNamespace(residuals_at_noise_level=False), {}, BLIND)
    groups = {"fuselage_drag": ("fuselage_drag",)}
    rows = selection.Selection(job, None, groups, Reporter())._rows(standing, {})
    assert [(row.group, row.kept, row.reason) for row in rows] == [
        (LINEAR, True, SelectionCode.OPEN_LOOP),
        ("marker_tilt", True, SelectionCode.HOVERS_TILTED),
        ("fuselage_drag", False, SelectionCode.NOT_SIGNIFICANT),
    ]
    assert (rows[0].names, rows[0].gain_fit, rows[0].gain_holdout) == (drag, 0.4, 0.3)
    assert selection_in_words(rows) == f"Added to Gazebo's motor model: {LINEAR} and marker_tilt."


def test_a_job_that_wants_no_terms_gets_none():
    for job in (JobFile(terms="none"), JobFile(free=BASE)):
        without = with_terms_selected(*unfitted_with(DRAG, seed=0, job=job), Reporter())
        assert not without.rows
        assert without.job.space.names == BASE_IN_ORDER


BASE_IN_ORDER = ("inertia_xx", "motor_constant", "rotor_drag_coefficient")

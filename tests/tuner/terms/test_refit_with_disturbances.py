"""Fits that noise alone is left of are not touched; when two fits contradict each other."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from tests.tuner.uncertainty.making import ended
from tuner.config import JobFile
from tuner.disturbances.disturbances import INITIAL_STRENGTHS
from tuner.disturbances.maximum_likelihood import MAX_STEPS
from tuner.equation_error.omitted_laws import Law
from tuner.findings.findings import Code, Finding
from tuner.search.findings import unmatched_findings
from tuner.search.listener import Listener, Reporter
from tuner.search.problem import Job
from tuner.search.progress import COLOURED_RATIO, Fit
from tuner.terms import refit_with_disturbances as disturbances
from tuner.terms.candidates import SelectionResult
from tuner.terms.refit_with_disturbances import (
    ROUGH_STEPS,
    _findings_with_disturbances,
    _without_contradicted_lag,
    with_disturbances,
)
from tuner.uncertainty.model_error import ModelErrors

NOBODY = cast(Any, None)


def fitted(scale: float) -> Fit:
    return ended(
        objective=NOBODY,
        point=NOBODY,
        criterion=NOBODY,
        noise={},
        scales={"circle": {"position": 1.0, "command": scale}},
    )


@pytest.mark.parametrize(
    ("fit", "asked"),
    [
        (fitted(1.05), "follow"),
        (replace(fitted(2.0 * COLOURED_RATIO), polished=False), "follow"),
        (fitted(2.0 * COLOURED_RATIO), "none"),
        (fitted(2.0 * COLOURED_RATIO), "auto"),
    ],
    ids=["nothing but noise is left", "the search is not at its end", "not asked for", "no terms"],
)
def test_nothing_is_fitted_again_without_need(fit: Fit, asked: str) -> None:
    said: list[str] = []
    settings = SimpleNamespace(job=JobFile(disturbances=asked, terms="none"))
    job = cast(Job, SimpleNamespace(settings=settings))
    assert (
        with_disturbances(SelectionResult(job, fit), Reporter(Listener(on_message=said.append)))
        is None
    )
    assert said == []


@pytest.mark.parametrize(("gains", "says"), [(501, True), (500, False)])
def test_flights_whose_gains_would_not_fit_are_left_to_the_intervals(monkeypatch, gains, says):
    full = SimpleNamespace(objective=SimpleNamespace(memory=1000), point=NOBODY)
    predictor = SimpleNamespace(memory=gains)
    monkeypatch.setattr(disturbances, "full_problem_of", lambda *_: full)
    monkeypatch.setattr(disturbances.Predictor, "of", lambda *_: predictor)
    job = cast(
        Job,
        SimpleNamespace(settings=SimpleNamespace(job=JobFile(disturbances="follow")), fitted=()),
    )
    said: list[str] = []
    with nullcontext() if says else pytest.raises(AttributeError):  # goes on with what lacks
        selected = SelectionResult(job, fitted(2.0 * COLOURED_RATIO))
        found = with_disturbances(selected, Reporter(Listener(on_message=said.append)))
        assert found is None
    assert ("Disturbances are not estimated" in said[0]) == says


@pytest.mark.parametrize(
    ("moved", "errors", "agrees"),
    [
        (3.9, (1.0, 0.1), True),
        (4.2, (1.0, 0.1), False),
        (20.0, (1.0, 10.0), True),
        (50.0, (1.0, 10.0), False),
    ],
    ids=["within chance", "beyond", "hardly told by set-points", "beyond that"],
)
def test_two_fits_contradict_each_other_by_the_errors_of_both(moved, errors, agrees):
    old, new = (
        cast(Any, SimpleNamespace(estimates={"drag": SimpleNamespace(value=at, std_error=error)}))
        for at, error in zip((0.0, moved), errors, strict=True)
    )
    new.estimates["freed"] = SimpleNamespace(value=1e9, std_error=1.0)
    assert disturbances._estimates_agree(new, old) == agrees


@pytest.mark.parametrize(
    ("called_for", "descents"),
    [
        ([None, None], [ROUGH_STEPS, MAX_STEPS]),
        (["drag", None], [ROUGH_STEPS, MAX_STEPS]),
        ([None, "drag", None], [ROUGH_STEPS, MAX_STEPS, MAX_STEPS]),
        (["drag", "battery", "inflow", "more"], [ROUGH_STEPS, MAX_STEPS, MAX_STEPS, MAX_STEPS]),
    ],
    ids=["nothing", "at once", "later", "again and again"],
)
def test_terms_are_chosen_before_the_descent_and_after_it(monkeypatch, called_for, descents):
    """What is missing would be taken for disturbances by a descent to its end."""
    full = SimpleNamespace(objective=SimpleNamespace(memory=2), point=NOBODY)
    predictor = SimpleNamespace(memory=0, is_lost=False, keeps_track=False)
    predictor.without_gains = predictor
    monkeypatch.setattr(disturbances, "full_problem_of", lambda *_: full)
    monkeypatch.setattr(disturbances.Predictor, "of", lambda *_: predictor)
    settings = SimpleNamespace(job=JobFile(disturbances="follow"))
    job = cast(Job, SimpleNamespace(settings=settings, fitted=()))
    begin = SelectionResult(job, fitted(2.0 * COLOURED_RATIO))
    taken, within, asked = [], [], iter(called_for)

    def descended(selected: SelectionResult, there: Fit, own: Any, steps: int = MAX_STEPS) -> Any:
        taken.append(steps)
        within.append([row.group for row in selected.rows])
        return there, own

    def seen(selected: SelectionResult, *_: Any) -> Any:
        def selection(had: Any, *, first: bool) -> SelectionResult | None:
            assert first == (len(taken) == 1)
            assert not had
            group = next(asked)
            row = SimpleNamespace(group=group, kept=True)
            return replace(selected, rows=(*selected.rows, row)) if group else None

        return SimpleNamespace(selected=selected, selection=selection)

    monkeypatch.setattr(disturbances, "_fit_innovations", descended)
    monkeypatch.setattr(disturbances.LinearisedInnovations, "of", seen)
    assert with_disturbances(begin, Reporter()) is None  # keeps no track
    assert taken == descents
    assert within[-1] == [group for group in called_for[: len(descents) - 1] if group]


def test_no_terms_are_selected_by_innovations_of_a_diverged_filter(monkeypatch):
    full = SimpleNamespace(objective=SimpleNamespace(memory=2), point=NOBODY)
    predictor = SimpleNamespace(memory=0, is_lost=True)
    monkeypatch.setattr(disturbances, "full_problem_of", lambda *_: full)
    monkeypatch.setattr(disturbances.Predictor, "of", lambda *_: predictor)
    monkeypatch.setattr(disturbances, "_fit_innovations", lambda *_, **__: (None, predictor))
    settings = SimpleNamespace(job=JobFile(disturbances="follow"))
    job = cast(Job, SimpleNamespace(settings=settings, fitted=()))
    said: list[str] = []
    found = with_disturbances(
        SelectionResult(job, fitted(2.0 * COLOURED_RATIO)),
        Reporter(Listener(on_message=said.append)),
    )
    assert found is None
    assert said[-1] == disturbances.FILTER_LOST


def test_a_fit_with_a_lag_whose_filter_loses_a_flight_is_not_taken(monkeypatch):
    full = SimpleNamespace(objective=SimpleNamespace(memory=2), point=NOBODY)
    tracks, loses = (SimpleNamespace(memory=0, is_lost=False, keeps_track=t) for t in (True, False))
    tracks.without_gains = tracks
    monkeypatch.setattr(disturbances, "full_problem_of", lambda *_: full)
    monkeypatch.setattr(disturbances.Predictor, "of", lambda *_: tracks)
    monkeypatch.setattr(disturbances, "_fit_innovations", lambda _, there, own, **__: (there, own))
    settings = SimpleNamespace(job=JobFile(disturbances="follow"))
    job = cast(Job, SimpleNamespace(settings=settings, fitted=()))
    begin = SelectionResult(job, fitted(2.0 * COLOURED_RATIO))
    seen = SimpleNamespace(selected=begin, selection=lambda *_, **__: None)
    monkeypatch.setattr(disturbances.LinearisedInnovations, "of", lambda *_: seen)
    monkeypatch.setattr(
        disturbances, "_with_lag_terms", lambda found, there, *_: (found, there, loses)
    )
    said: list[str] = []
    assert with_disturbances(begin, Reporter(Listener(on_message=said.append))) is None
    assert said[-1] == disturbances.FILTER_LOST


@pytest.mark.parametrize(
    ("others", "titles", "lag"), [(True, 2, False), (False, 1, False), (True, 1, True)]
)
def test_a_fit_of_other_terms_is_compared_with_one_of_the_same(monkeypatch, others, titles, lag):
    """A fit of another model cannot contradict this one, nor can one without a lag.

    What the model lacks, without a lateness that samples contradict, acts as terms that were left
    out are judged.
    """
    full = SimpleNamespace(objective=SimpleNamespace(memory=2), point=NOBODY)
    predictor = SimpleNamespace(
        memory=0,
        is_lost=False,
        keeps_track=True,
        strengths=INITIAL_STRENGTHS,
        matched=np.zeros(0, bool),
    )
    predictor.without_gains = predictor
    settings = SimpleNamespace(job=JobFile(disturbances="follow"))
    space = SimpleNamespace(names=("inertia_xx",))
    job = cast(Job, SimpleNamespace(settings=settings, fitted=(), space=space))
    row = SimpleNamespace(group="fuselage_drag", kept=True, names=("fuselage_drag", "wind_x"))
    begin = SelectionResult(job, fitted(2.0 * COLOURED_RATIO), (cast(Any, row),))
    model_errors = ModelErrors((Law("force_z", "airspeed_across", 0.2),), None)
    polished, examined, read = [], [], []
    chosen = iter([replace(begin, rows=()) if others else None, None])

    def seen(selected: SelectionResult, *_: Any) -> Any:
        return SimpleNamespace(
            selected=selected,
            selection=lambda *_, **__: next(chosen),
            contradicts=lambda *_: True,
            with_model_error=lambda model_errors, _: SimpleNamespace(
                with_doubts=lambda: replace(selected, selection_shifts={"acting": model_errors})
            ),
        )

    def with_lag_terms(found: Any, there: Fit, own: Any, _: Any) -> Any:
        return (seen(replace(found.selected)) if lag else found), there, own

    def polish(_: Job, fit: Fit, *, title: str, left: Any = None, **__: Any) -> Fit:
        polished.append(title)
        assert (left is not None) == (title == "simulated"), "rough where it is not kept"
        return replace(fit, wall_time=float(len(polished)))

    def examine(fit: Fit, *, selection_shifts: Any, predictor: Any = None, **_: Any) -> Any:
        examined.append(fit)
        assert predictor is None or selection_shifts == {"acting": model_errors}
        return SimpleNamespace(uncertainty=NOBODY)

    monkeypatch.setattr(disturbances, "full_problem_of", lambda *_: full)

    def predictor_of(*given: Any) -> Any:
        assert given[3] == ("fuselage_drag",), "computed where it is dropped, too"
        return predictor

    monkeypatch.setattr(disturbances.Predictor, "of", predictor_of)
    monkeypatch.setattr(disturbances, "_fit_innovations", lambda _, there, own, **__: (there, own))
    monkeypatch.setattr(disturbances.LinearisedInnovations, "of", seen)
    monkeypatch.setattr(disturbances, "free_parameters", lambda *_, **__: None)
    monkeypatch.setattr(disturbances, "polished", polish)
    monkeypatch.setattr(disturbances, "alternatives_of", lambda *given: read.append(given[2:]))
    monkeypatch.setattr(
        disturbances, "model_errors_of", lambda *_: replace(model_errors, speed_lag=0.012)
    )
    monkeypatch.setattr(disturbances, "examine", examine)
    monkeypatch.setattr(disturbances, "_with_lag_terms", with_lag_terms)
    monkeypatch.setattr(disturbances, "_estimates_agree", lambda *_: not lag)
    monkeypatch.setattr(disturbances, "_is_sharper", lambda *_: True)
    assert with_disturbances(begin, Reporter()) is not None
    assert polished == ["clocks", "simulated"][:titles]
    assert len(examined) == 2 - lag
    assert (examined[-1] is begin.fitted) == (titles == 1 and not lag)
    assert read[0] == (job.fitted,)  # whose voltmeters are read again


@pytest.mark.parametrize("size", [20.0, 90.0], ids=["like others", "alone"])
def test_a_flight_that_disturbances_explain_is_not_reported_as_unmatched(size: float) -> None:
    """White innovations match a flight; one channel that is too large does not."""
    random = np.random.default_rng(0)
    white = random.normal(size=(500, 6, 4))
    white[:, 4, 1] *= 1.5
    white[::2, :, 2] = 0.0  # ticks without samples
    names = ("spin", "odd", "sparse", "calm")
    scales = {name: {"position": 12.0} for name in names} | {"spin": {"position": size}}
    fit = replace(fitted(1.0), scales=scales)
    fit = replace(fit, findings=tuple(unmatched_findings(scales)))
    assert len(fit.findings) == (1 if size == 20.0 else 2)
    predictor = SimpleNamespace(
        found=SimpleNamespace(white=white),
        inputs=SimpleNamespace(widths={"position": 3, "attitude": 3}),
        strengths=INITIAL_STRENGTHS,
    )
    predictor.matched = disturbances.Predictor.matched.fget(predictor)
    job = SimpleNamespace(fitted=[SimpleNamespace(name=name) for name in names])
    left, followed = _findings_with_disturbances(*cast(Any, (job, fit, predictor)))
    numbers = {"unmatched": 1, "flights": 4, "noise_multiple": 12.0}
    assert left == Finding(Code.MODEL_UNMATCHED, "warning", "model", numbers)
    assert followed.code is Code.DISTURBANCES_FOLLOWED


def test_a_lateness_that_samples_contradict_is_not_believed():
    law = Law("force_z", "airspeed_across", 0.2)
    seconds, both = {"tachometer_lag": 0.012}, ModelErrors((law,), None, speed_lag=0.012)

    def believed(model_errors: ModelErrors | None, *, contradicted: bool) -> ModelErrors | None:
        def contradicts(name: str, value: float) -> bool:
            return contradicted and value == seconds[name]

        return _without_contradicted_lag(
            model_errors, cast(Any, SimpleNamespace(contradicts=contradicts))
        )

    assert believed(both, contradicted=False) == both
    assert believed(both, contradicted=True) == ModelErrors((law,), None)
    assert believed(ModelErrors((), None, speed_lag=0.012), contradicted=True) is None
    assert believed(None, contradicted=True) is None


def test_of_several_lags_those_stay_that_innovations_call_for(monkeypatch):
    """Each is judged beside the others, and the fit is repeated with the rest."""
    full = SimpleNamespace(objective=NOBODY, point=SimpleNamespace(coefficients=np.zeros(0)))
    beside = SimpleNamespace(
        keeps_track=True,
        is_likelier_than=lambda _: True,
        inputs=SimpleNamespace(offsets=np.zeros((5, 1))),
        at=lambda *_: beside,
    )
    beside.without_gains = beside
    monkeypatch.setattr(disturbances, "full_problem_of", lambda *_: full)
    monkeypatch.setattr(disturbances, "_fit_innovations", lambda _, there, __: (there, beside))

    def seen(selected: SelectionResult, *_: Any) -> Any:
        def grown(among: Any = None) -> SelectionResult:
            groups = among or ("gyro_filter", "motor_lag")
            more = (SimpleNamespace(group=group, kept=True) for group in groups)
            return replace(selected, rows=(*selected.rows, *more))

        return SimpleNamespace(
            selected=selected,
            with_lag_terms=grown,
            called_for=lambda _: ("gyro_filter",),
            selection=lambda _: None,
        )

    monkeypatch.setattr(disturbances.LinearisedInnovations, "of", seen)
    begin = SelectionResult(NOBODY, fitted(2.0 * COLOURED_RATIO))
    found, *_ = disturbances._with_lag_terms(
        seen(begin), begin.fitted, cast(Any, beside), lambda _: None
    )
    assert [row.group for row in found.selected.rows] == ["gyro_filter"]


@pytest.mark.parametrize(
    ("lacks", "called_for", "expected"),
    [
        ("", None, ["motor_lag"]),
        ("", "drag", ["motor_lag", "drag"]),
        ("likelihood", None, []),
        ("significance", None, []),
        ("track", None, []),
    ],
    ids=["surely likelier", "others come with it", "by chance", "one gust", "loses track"],
)
def test_a_term_without_a_derivative_is_judged_by_a_fit_with_it(
    monkeypatch, lacks, called_for, expected
):
    full = SimpleNamespace(objective=NOBODY, point=SimpleNamespace(coefficients=np.zeros(0)))
    beside = SimpleNamespace(
        keeps_track=lacks != "track", is_likelier_than=lambda _: lacks != "likelihood"
    )
    beside.without_gains = beside
    without = SimpleNamespace(inputs=SimpleNamespace(offsets=np.zeros((5, 1))), keeps_track=True)
    without.without_gains = without
    without.at = lambda *_: "as it was"
    monkeypatch.setattr(disturbances, "full_problem_of", lambda *_: full)
    monkeypatch.setattr(disturbances, "_fit_innovations", lambda _, there, __: (there, beside))
    begin = SelectionResult(NOBODY, fitted(2.0 * COLOURED_RATIO))

    def seen(selected: SelectionResult, *_: Any) -> Any:
        def grown(group: str | None) -> SelectionResult | None:
            row = SimpleNamespace(group=group, kept=True)
            return replace(selected, rows=(*selected.rows, row)) if group else None

        return SimpleNamespace(
            selected=selected,
            with_lag_terms=lambda _: grown("motor_lag"),
            called_for=lambda lags: () if lacks == "significance" else tuple(lags),
            selection=lambda _: grown(called_for),
        )

    monkeypatch.setattr(disturbances.LinearisedInnovations, "of", seen)
    found, _, predictor = disturbances._with_lag_terms(
        seen(begin), begin.fitted, cast(Any, without), lambda _: None
    )
    assert [row.group for row in found.selected.rows] == expected
    assert predictor == (beside if expected else "as it was")

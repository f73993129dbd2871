"""Searches that end where the vehicle does not fly what was recorded: nothing is made of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from tests.tuner.terms.making import unfitted_with
from tuner.objective import residuals
from tuner.search.listener import Reporter
from tuner.search.progress import COLOURED_RATIO, Fit
from tuner.terms import refit_with_disturbances, selection
from tuner.terms.candidates import SelectionResult


def ended_with(thrust: float, monkeypatch: pytest.MonkeyPatch) -> tuple[SelectionResult, list[str]]:
    """Return what a search comes to that ends with so much of the thrust, and what it tried."""
    job, start = unfitted_with(0.0, seed=0)
    space, tried = job.space, list[str]()
    values = space.numbers(start.point.coefficients)
    values["motor_constant"] *= thrust
    point = start.objective.start(space.vector_of(values))
    scales = {name: {"position": 2.0 * COLOURED_RATIO} for name in start.scales}
    end = replace(start, point=point, scales=scales)

    def selecting(job: Any, fitted: Fit, *_: Any) -> SelectionResult:
        tried.append("terms")
        return SelectionResult(job, fitted)

    monkeypatch.setattr(selection, "search", lambda *_, **__: end)
    monkeypatch.setattr(selection, "point_estimates", lambda *_: ())
    monkeypatch.setattr(selection, "with_terms_selected", selecting)
    found = selection.search_with_terms(
        job,
        cast(Path, None),
        resume=False,
        reporter=Reporter(),
    )
    return found, tried


def followed(selected: SelectionResult, monkeypatch: pytest.MonkeyPatch) -> bool:
    """Return whether disturbances are estimated of a selection's fit."""
    tried = list[str]()
    held = selected.fitted, SimpleNamespace()

    def following(*_: Any, **__: Any) -> None:
        tried.append("disturbances")

    monkeypatch.setattr(refit_with_disturbances, "with_disturbances", following)
    monkeypatch.setattr(refit_with_disturbances, "hold_undetermined", lambda *_, **__: held)
    examined = refit_with_disturbances.refit_and_examine(selected, Reporter())
    assert examined == (selected, held[1])
    return bool(tried)


@pytest.mark.parametrize(("thrust", "flies"), [(1.0, True), (0.3, False)])
def test_neither_terms_nor_disturbances_explain_a_vehicle_that_falls(thrust, flies, monkeypatch):
    found, tried = ended_with(thrust, monkeypatch)
    assert found.refuted is not flies
    assert tried == (["terms"] if flies else [])
    assert followed(found, monkeypatch) is flies


def test_derivatives_that_grow_along_flights_that_are_met_refute_at_the_end_alone(monkeypatch):
    monkeypatch.setattr(residuals, "MAX_DERIVATIVE", 1e-9)
    found, tried = ended_with(1.0, monkeypatch)
    assert tried == ["terms"]
    assert found.refuted


@pytest.mark.parametrize(("others", "follows"), [(1.0, False), (2.0 * COLOURED_RATIO, True)])
def test_a_misfit_of_one_flight_alone_is_no_disturbance(others, follows, monkeypatch):
    found, _ = ended_with(1.0, monkeypatch)
    scales = {"a": {"position": others}, "stray": {"position": 50.0}, "b": {"position": others}}
    found = replace(found, fitted=replace(found.fitted, scales=scales))
    assert followed(found, monkeypatch) is follows

"""Fits that measurement noise alone is left of are not touched."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import pytest

from tuner.config import JobFile
from tuner.job import disturbances
from tuner.job.disturbances import with_disturbances
from tuner.job.prepare import Job
from tuner.search.fitted import COLOURED, Fitted

NOBODY = cast(Any, None)


def fitted(scale: float) -> Fitted:
    return Fitted(
        objective=NOBODY,
        point=NOBODY,
        criterion=NOBODY,
        noise={},
        scales={"circle": {"position": 1.0, "command": scale}},
        iterations=(),
        outcomes=(),
        method="gradient",
        evaluations=0,
        wall_time=0.0,
        loss_best=1.0,
        converged=True,
    )


@pytest.mark.parametrize(
    ("fit", "asked"),
    [
        (fitted(1.05), "follow"),
        (replace(fitted(2.0 * COLOURED), polished=False), "follow"),
        (fitted(2.0 * COLOURED), "none"),
        (fitted(2.0 * COLOURED), "auto"),
    ],
    ids=["nothing but noise is left", "the search is not at its end", "not asked for", "no terms"],
)
def test_nothing_is_fitted_again_without_need(fit: Fitted, asked: str) -> None:
    said: list[str] = []
    settings = SimpleNamespace(job=JobFile(disturbances=asked, terms="none"))
    job = cast(Job, SimpleNamespace(settings=settings))
    assert with_disturbances(job, fit, lambda *_: None, said.append) is None
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
        found = with_disturbances(job, fitted(2.0 * COLOURED), lambda *_: None, said.append)
        assert found is None
    assert bool(said) == says

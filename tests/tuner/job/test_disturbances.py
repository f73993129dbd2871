"""Fits that noise alone is left of are not touched; what innovations say of terms left out."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from tests.tuner.uncertainty import making
from tuner.coefficients.space import extended, space_of
from tuner.config import JobFile
from tuner.job import disturbances
from tuner.job.disturbances import with_disturbances
from tuner.job.prepare import Job
from tuner.job.selected import Selected
from tuner.search.fitted import COLOURED, Fitted
from tuner.selection.candidates import start_of
from tuner.selection.table import SelectionCode, SelectionRow
from tuner.uncertainty.information import FisherInformation

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
    assert with_disturbances(Selected(job, fit), lambda *_: None, said.append) is None
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
        selected = Selected(job, fitted(2.0 * COLOURED))
        found = with_disturbances(selected, lambda *_: None, said.append)
        assert found is None
    assert bool(said) == says


def information(names: Sequence[str], seen: Sequence[str], alike: float) -> FisherInformation:
    """Return what 40 stretches of four flights say of some coefficients, much alike or not."""
    rng, count = np.random.default_rng(3), len(names)
    shared, own = rng.standard_normal((4, 40, 50, 1)), rng.standard_normal((4, 40, 50, count))
    rows = np.sqrt(alike) * shared + np.sqrt(1.0 - alike) * own
    rows = 10.0 * rows * np.isin(names, list(seen))
    noise = rng.standard_normal(rows.shape[:3])
    return FisherInformation(
        channels=("position",),
        flight=np.arange(4),
        blocks=np.einsum("fbnp,fbnq->fbpq", rows, rows)[None],
        score=np.einsum("fbnp,fbn->fbp", rows, noise)[None],
        spread=np.ones((1, 4)),
        nuisance_prior=np.zeros((count, count)),
        prior=np.eye(count),
        crashed=np.zeros(4, bool),
        begins=np.zeros(4),
        scale=np.ones((1, 4)),
    )


@pytest.mark.parametrize("alike", [0.0, 0.95])
def test_terms_left_out_are_in_doubt_by_what_innovations_say_of_them(monkeypatch, alike):
    """As far as they do what a coefficient does; what set-points hide stays as it was."""
    job = cast(Job, SimpleNamespace(settings=SimpleNamespace(job=JobFile())))
    space = space_of(
        making.vehicle_file(),
        making.controller_file(),
        JobFile(free=("inertia_xx", "estimate_latency")),
    )
    term = ("fuselage_drag",)
    wide = SimpleNamespace(space=extended(space, term, JobFile(), start_of(term)), simulator=NOBODY)
    point = SimpleNamespace(coefficients=wide.space.initial)
    again = replace(fitted(2.0), objective=SimpleNamespace(space=space))
    asked: list[Sequence[str]] = []

    def widened(_job: Job, _fit: Fitted, names: Sequence[str]) -> tuple[Any, Any]:
        asked.append(names)
        return None, SimpleNamespace(objective=wide, point=point)

    def said(*_: object) -> FisherInformation:
        return information(wide.space.names, ("inertia_xx", "fuselage_drag"), alike)

    monkeypatch.setattr(disturbances, "extended", widened)
    monkeypatch.setattr(disturbances, "replace", lambda *_, **__: SimpleNamespace(information=said))
    rows = tuple(
        SelectionRow(group=names[0], names=names, kept=False, reason=SelectionCode.NOT_SIGNIFICANT)
        for names in (("fuselage_drag",), ("wind_x", "wind_y"))
    )
    before = {"inertia_xx": 9.0, "estimate_latency": 7.0}
    found = disturbances._in_doubt(Selected(job, again, rows, before), again, NOBODY)
    assert asked == [["fuselage_drag"]]
    assert found["estimate_latency"] == 7.0
    assert (found["inertia_xx"] < 2e-4) == (alike == 0.0)
    assert found["inertia_xx"] < 9.0

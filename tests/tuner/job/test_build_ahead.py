"""The kernels that the process beside a job builds are those that the job then flies."""

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from lanes import Program
from tuner.config import JobFile, resolve_settings
from tuner.core.runtime import configure
from tuner.evaluate.comparison import Comparison
from tuner.job import prepare
from tuner.objective.trajectory import build_publishers
from tuner.options import Options
from tuner.search.progress import plain_criterion
from tuner.terms.candidates import with_terms
from tuner.terms.selection import candidates_of
from tuner.uncertainty.model_error import STEP, alternatives_of
from tuner.vehicle import with_values

FLIGHT = Path(__file__).parents[3] / "reference_flights" / "diagonal_3mps.bag"
TERM = ("linear_drag_x",)


class _FlownError(Exception):
    """Instead of a flight: its argument is the program."""


def _fly(program: Program, *_: object, **__: object) -> None:
    raise _FlownError(program)


def _flown(fly: Callable[[], object]) -> Program:
    with pytest.raises(_FlownError) as flown:
        fly()
    program: Program = flown.value.args[0]
    return program


@pytest.mark.parametrize("inlet", ["reference", "actuator"])
@pytest.mark.parametrize("terms", ["auto", "none", "linear_drag"])
def test_what_a_job_flies_is_built_ahead(inlet, terms, monkeypatch):
    terms = terms if terms in ("auto", "none") else (terms,)
    settings = resolve_settings(Options([str(FLIGHT)]))
    settings = replace(settings, job=JobFile(inlet=inlet, terms=terms))
    job, _ = prepare.prepare(settings)
    asked_for: list[tuple[object, ...]] = []
    monkeypatch.setattr(prepare, "do_beside", lambda *what: asked_for.append(what))
    monkeypatch.setattr(Program, "is_kept", False)
    prepare.build_ahead(job)
    assert asked_for.pop(0) == (configure,)
    assert asked_for.pop() == (os._exit, 0)  # it holds no memory once it has nothing to do
    assert ((build_publishers,) in asked_for) == (inlet == "reference")
    ahead = [what[1] for what in asked_for if what[0] is Program.build]
    assert len(set(ahead)) == len(ahead) == len(asked_for) - (inlet == "reference")

    monkeypatch.setattr(Program, "__call__", _fly)
    objective, comparison = job.objective, Comparison(job.recordings, settings.controller)
    point, criterion = objective.start(job.space.initial), plain_criterion(objective, 10)
    needed = {_flown(lambda: comparison.fly(settings.vehicle))}
    alternatives = alternatives_of(objective, point)
    if inlet == "reference":
        needed.add(_flown(lambda: alternatives[STEP].residuals(point, criterion)))
    first = _flown(lambda: objective.sums(point, criterion))
    if candidates_of(job):
        with_term = with_terms(objective, point, TERM, settings.job)
        needed.add(_flown(lambda: with_term[0].sums(with_term[1], criterion)))
    if terms == ("linear_drag",):
        dragged = with_values(settings.vehicle, dict.fromkeys(TERM, 0.1))
        needed.add(_flown(lambda: comparison.fly(dragged)))
    assert needed <= set(ahead)
    assert first not in ahead

"""What a search that is done again forgets, and what it keeps."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from tests.tuner.uncertainty.making import FLIGHTS, NOISE, fitted_of, problem, truth
from tuner.config import JobFile
from tuner.objective.criterion import Point
from tuner.search import estimation
from tuner.search.progress import Loop, initial_progress, loop_of, with_loop
from tuner.vehicle import ControllerFile

PLAIN = ("motor_constant", "inertia_xx", "inertia_yy")


@pytest.mark.parametrize("choice", Loop._fields)
@pytest.mark.parametrize("own", [0.0, 1.0])
def test_a_search_from_anew_decides_again_from_the_set_ups_own_loop(monkeypatch, own, choice):
    """A model that lacked terms may have chosen the wrong one."""
    own = Loop()._replace(**{choice: own})
    objective, tell = with_loop(problem(PLAIN), own), np.ones(len(FLIGHTS), bool)
    fitted = fitted_of(with_loop(objective, own.switched(choice)), truth(objective))
    job = SimpleNamespace(
        objective=objective,
        settings=SimpleNamespace(job=JobFile(), controller=ControllerFile()),
        fitted=[SimpleNamespace(name=name) for name in FLIGHTS],
        undecided=lambda _: {choice: tell},
    )
    asked = {}

    def grown(_, __, progress, *, undecided, **___):
        asked.update(undecided=undecided, loop=progress.loop)
        scales = {name: np.ones(len(FLIGHTS)) for name in NOISE}
        loop = own.switched(choice)
        return replace(progress, loop=loop, scales=scales, losses=np.ones(1))

    monkeypatch.setattr(estimation, "run_stages", grown)
    free = Point(np.ones(3, bool), np.zeros(fitted.point.offsets.shape, bool))
    said = {"free": free, "title": "again", "on_progress": lambda _: None}
    again = estimation.polished(
        job, fitted, start=objective.space.initial, stages=estimation.ALL_BUT_LAST, **said
    )
    assert asked == {"undecided": {choice: tell}, "loop": own}
    assert loop_of(again.objective) == own.switched(choice)
    estimation.polished(job, again, **said)
    assert asked == {"undecided": {}, "loop": own.switched(choice)}


@pytest.mark.parametrize(("left", "steps"), [(None, 2), (1e-3, 1)])
def test_a_rough_fit_ends_where_a_linear_step_is_left(left, steps):
    """From where noise alone is left a step gains less than a thousandth of the loss."""
    objective = problem(PLAIN, seed=0)
    true = np.array(truth(objective).coefficients)
    fitted = fitted_of(objective, objective.start(true + 0.02 * true))
    job = SimpleNamespace(
        objective=objective,
        settings=SimpleNamespace(job=JobFile(), controller=ControllerFile()),
        fitted=[SimpleNamespace(name=name) for name in FLIGHTS],
    )
    free = Point(np.ones(3, bool), np.zeros(fitted.point.offsets.shape, bool))
    again = estimation.polished(
        job,
        fitted,
        free=free,
        title="again",
        on_progress=lambda _: None,
        stages=estimation.FIRST_POLISH,
        left=left,
    )
    made = again.iterations[len(fitted.iterations) :]
    assert len(made) == steps


@pytest.mark.parametrize("own", [Loop(0.0, 1.0), Loop(1.0, 0.0)])
def test_a_search_begins_with_the_set_ups_own_loop(own):
    objective = with_loop(problem(PLAIN), own)
    assert initial_progress(objective, np.asarray(objective.space.initial)[None]).loop == own

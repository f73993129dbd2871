"""What a search that is done again forgets, and what it keeps."""

from dataclasses import replace
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from tests.tuner.uncertainty.making import FLIGHTS, NOISE, fitted_of, problem, truth
from tuner.config import JobFile
from tuner.job import polish
from tuner.search.optimiser import Free
from tuner.search.progress import beginning, feedback_of, with_feedback


@pytest.mark.parametrize("own", [0.0, 1.0])
def test_a_search_from_anew_tries_the_feedback_again_from_the_set_ups_own(monkeypatch, own):
    """A model that lacked terms may have chosen the wrong one."""
    objective = with_feedback(problem(("motor_constant", "inertia_xx", "inertia_yy")), own)
    fitted = fitted_of(with_feedback(objective, 1.0 - own), truth(objective))
    job = SimpleNamespace(
        objective=objective,
        settings=SimpleNamespace(job=JobFile()),
        fitted=[SimpleNamespace(name=name) for name in FLIGHTS],
        clipped=True,
    )
    asked = {}

    def grown(_, __, progress, *, clipped, **___):
        asked.update(clipped=clipped, feedback=progress.feedback)
        scales = {name: np.ones(len(FLIGHTS)) for name in NOISE}
        return replace(progress, feedback=1.0 - own, scales=scales, losses=np.ones(1))

    monkeypatch.setattr(polish, "grow", grown)
    free = Free(np.ones(3, bool), np.zeros(fitted.point.offsets.shape, bool))
    said = {"free": free, "title": "again", "on_progress": lambda _: None}
    again = polish.searched_again(job, fitted, objective.space.initial, **said)
    assert asked == {"clipped": True, "feedback": own}
    assert feedback_of(again.objective) == 1.0 - own
    polish.polished(job, again, **said)
    assert asked == {"clipped": False, "feedback": 1.0 - own}


@pytest.mark.parametrize("own", [0.0, 1.0])
def test_a_search_begins_with_the_set_ups_own_feedback(own):
    objective = SimpleNamespace(
        segments=SimpleNamespace(measured={}, freedom=None),
        flights=2,
        start=lambda _: SimpleNamespace(offsets=jnp.zeros((5, 2))),
        model=SimpleNamespace(
            controller=SimpleNamespace(rate=SimpleNamespace(saturation_feedback=jnp.asarray(own)))
        ),
    )
    assert beginning(objective, np.ones((1, 3))).feedback == own

"""Clocks that recordings can do without are right; those that differ from the others stay late."""

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from tuner.objective.criterion import Point
from tuner.objective.segments import CLOCKS, OFFSETS
from tuner.search import continuation
from tuner.search.progress import criterion_of
from tuner.search.stages import Stage

FLIGHTS, POSE = 3, 0
KNOWN, ALONE = 1e4, 10.0
"""Information about latency and clock together, and about each clock by itself."""


def stays(monkeypatch, late):
    """Return which pose clocks stay, of flights whose poses are late by so much at the minimum.

    What is recorded says when the vehicle moved: latency (the one coefficient) and clock together.
    """
    kinds = len(OFFSETS)
    rows = np.zeros((FLIGHTS, 1 + kinds * FLIGHTS))
    rows[:, 0] = 1.0
    rows[np.arange(FLIGHTS), 1 + POSE * FLIGHTS + np.arange(FLIGHTS)] = 1.0
    hessian = KNOWN * rows.T @ rows + ALONE * np.eye(1 + kinds * FLIGHTS)
    monkeypatch.setattr(
        continuation, "normal_equations", lambda *_: (100.0, np.zeros(len(hessian)), hessian)
    )
    objective = SimpleNamespace(space=[None], flights=FLIGHTS, flight=np.arange(FLIGHTS))
    offsets = np.zeros((1, kinds, FLIGHTS))
    offsets[0, POSE] = late
    offsets[0, -1] = 1.0  # a gyro's bias is no clock
    points = Point(jnp.zeros((1, 1)), jnp.asarray(offsets))
    free = Point(np.ones(1, bool), np.ones(offsets.shape[1:], bool))
    problem = SimpleNamespace(objective=objective, points=points, criterion=None, free=free)
    stay = continuation._clocks_that_differ(problem, 0, np.zeros(1))
    assert stay[2:].all()
    return stay[POSE].tolist()


@pytest.mark.parametrize(
    ("late", "stay"),
    [
        ((0.0, 0.0, 0.0), [False, False, False]),
        ((0.2, 0.2, 0.2), [False, False, False]),  # latency explains it as well
        ((0.2, 0.2, 0.5), [False, False, True]),
        ((0.0, 0.002, 0.0), [False, False, False]),
    ],
)
def test_clocks_stay_late_only_where_nothing_else_explains_it(monkeypatch, late, stay):
    assert stays(monkeypatch, late) == stay


def test_commands_are_read_exactly_at_the_clocks_in_seconds():
    offsets = np.full((5, 3), 2.0)  # of 10 ms each, as a `Point` has them
    criterion = criterion_of(Stage("polish", 100), {}, offsets)
    np.testing.assert_allclose(criterion.reference_offset, np.full((len(CLOCKS), 3), 0.02))

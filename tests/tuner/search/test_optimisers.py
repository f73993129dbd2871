"""An optimiser is added by one function: a stage names it, and so does a search's method."""

import importlib
import sys

import numpy as np
import pytest

from tests.tuner.uncertainty.making import problem
from tuner.objective.criterion import Point
from tuner.objective.segments import OFFSETS
from tuner.search.continuation import OPTIMISERS, run_stages
from tuner.search.progress import initial_progress
from tuner.search.stages import WHOLE_LENGTH, plan

FREE = ("inertia_zz", "motor_constant", "moment_constant")
MODULE = '''
import numpy as np

from tuner.objective.normal_equations import evaluate
from tuner.objective.criterion import Point, picked
from tuner.search.continuation import OPTIMISERS
from tuner.search.progress import Iterate


def coordinate_search(problem):
    """Try each coefficient a little higher and lower; halve the step when none helps."""
    width, vector = 0.2, np.asarray(problem.points.coefficients[problem.best])
    while True:
        reach = width * np.eye(len(vector))[problem.free.coefficients]
        tried = np.concatenate([vector[None], vector + reach, vector - reach])
        point = picked(problem.points, problem.best)
        losses = np.asarray(evaluate(problem.objective, tried, point, problem.criterion).loss)
        best = int(np.argmin(losses.sum(axis=-1)))
        width, vector = width if best else 0.5 * width, tried[best]
        yield Iterate(
            points=Point(vector[None], problem.points.offsets),
            losses=np.array([float(losses[best].sum())]),
            accepted=np.array([best > 0]),
            position_rmse=float("nan"),
            converged=width < 1e-3,
        )


OPTIMISERS["coordinate_search"] = coordinate_search
'''


@pytest.fixture
def added(tmp_path, monkeypatch):
    """The name of an optimiser that a module of its own adds."""
    (tmp_path / "coordinate_search.py").write_text(MODULE)
    monkeypatch.syspath_prepend(tmp_path)
    importlib.import_module("coordinate_search")
    yield "coordinate_search"
    del OPTIMISERS["coordinate_search"], sys.modules["coordinate_search"]


def test_an_added_optimiser_runs_the_stages_and_recovers_the_truth(added):
    fit = problem(FREE)
    rate = float(fit.schedule.log_rate)
    stages = plan(added, fit.samples, rate, windows=False, robust=False, steps=40)
    stages = [stage for stage in stages if stage.name in ("first 3 s", WHOLE_LENGTH)]
    reports = []
    start = np.asarray(fit.space.initial) + np.array([0.3, -0.2, 0.0])
    progress = run_stages(
        fit,
        tuple(stages),
        initial_progress(fit, start[None]),
        free=Point(np.array([True, True, False]), np.zeros((len(OFFSETS), 2), bool)),
        undecided={},
        on_progress=reports.append,
    )
    assert {report.iterations[-1].stage for report in reports} == {"first 3 s", WHOLE_LENGTH}
    assert reports[-1].iterate.points is progress.points
    assert progress.points.coefficients[0] == pytest.approx(fit.space.initial, abs=0.01)
    assert all(iteration.damping is None for iteration in progress.iterations)


def test_least_squares_reports_its_damping():
    fit = problem(FREE)
    stage = plan("gradient", fit.samples, 200.0, windows=False, robust=False, steps=3)[3]
    progress = run_stages(
        fit,
        (stage,),
        initial_progress(fit, np.asarray(fit.space.initial)[None] + [[0.05], [0.06]]),
        free=Point(np.ones(len(FREE), bool), np.zeros((len(OFFSETS), 2), bool)),
        undecided={},
        on_progress=lambda _: None,
    )
    first, second, *_ = (iteration.damping for iteration in progress.iterations)
    assert first == 1.0
    assert second == pytest.approx(0.2)  # the model predicted well: five times longer a step

"""The same numbers to the last bit, wherever they are computed and whichever worker is lost."""

import os
import shutil
import signal
import threading

import jax
import numpy as np
import pytest

from tests.tuner.engine import tasks
from tuner.config import TrajectorySettings, resolve_settings
from tuner.engine import using
from tuner.evaluate import closed_loop as simulation
from tuner.evaluate.closed_loop import simulate
from tuner.job.sensitivity import unfitted
from tuner.objective.criterion import Point
from tuner.objective.normal_equations import evaluate, sums_at
from tuner.options import Options
from tuner.search.job_flights import read_recordings
from tuner.search.problem import job_of
from tuner.uncertainty.refits import (
    BOOTSTRAP_FILE,
    CROSS_VALIDATION_FILE,
    bootstrap,
    cross_validate,
)
from tuner.vehicle import ControllerFile

FREE = ("inertia_xx", "motor_constant", "estimate_latency")


def same(here, there):
    jax.tree.map(np.testing.assert_array_equal, here, there)


@pytest.fixture(scope="module")
def two_flights(bag, tmp_path_factory):
    """A job of two short flights, nothing fitted yet."""
    folder = tmp_path_factory.mktemp("flights")
    names = [str(shutil.copyfile(bag, folder / f"{name}.bag")) for name in ("one", "two")]
    job = folder / "job.yaml"
    job.write_text(
        f"free: [{', '.join(FREE)}]\nterms: none\nsearch: {{max_iterations: 3}}\n"
        "flights: {two: {weight: 0.5}}\n"
    )
    settings = resolve_settings(Options(names, vehicle="hovergames", config=str(job)))
    prepared = job_of(settings, read_recordings(settings)[0])
    return prepared, unfitted(prepared)


@pytest.fixture(scope="module")
def problem(two_flights):
    """The same, as what a search moves: folds and points need the same programs."""
    _, fitted = two_flights
    return fitted.objective, fitted


def vectors_around(point, count):
    size = len(np.asarray(point.coefficients))
    drawn = np.random.default_rng(0).uniform(0.0, 0.001, (count, size))
    return np.asarray(point.coefficients) + drawn


@pytest.mark.slow
def test_points_are_computed_alike_alone_and_in_a_row_here_and_elsewhere(problem, two_workers):
    objective, fitted = problem
    vectors = vectors_around(fitted.point, 3)
    points = Point(vectors, np.stack([np.asarray(fitted.point.offsets)] * 3))
    here = sums_at(objective, points, fitted.criterion)
    alone = objective.sums(Point(vectors[1], points.offsets[1]), fitted.criterion)
    same(jax.tree.map(lambda leaf: leaf[1], here), alone)
    with using(two_workers):
        same(sums_at(objective, points, fitted.criterion), here)
    assert np.ptp(np.asarray(here.loss), axis=0).max() > 0.0


@pytest.mark.slow
def test_points_are_the_same_though_a_worker_is_lost(problem, two_workers):
    objective, fitted = problem
    vectors = vectors_around(fitted.point, 8)
    points = Point(vectors, np.stack([np.asarray(fitted.point.offsets)] * 8))
    here = sums_at(objective, points, fitted.criterion)
    workers = {one["pid"] for one in two_workers.map(tasks.about_the_process, range(8))}
    killing = threading.Timer(0.2, os.kill, (max(workers), signal.SIGKILL))
    with using(two_workers):
        killing.start()
        same(sums_at(objective, points, fitted.criterion), here)
    killing.join()
    assert max(workers) not in {
        one["pid"] for one in two_workers.map(tasks.about_the_process, range(8))
    }


@pytest.mark.slow
def test_populations_are_evaluated_alike(problem, two_workers):
    objective, fitted = problem
    vectors = vectors_around(fitted.point, 20)  # more than a chunk
    here = evaluate(objective, vectors, fitted.point, fitted.criterion)
    with using(two_workers):
        same(evaluate(objective, vectors, fitted.point, fitted.criterion), here)
    assert len(here.loss) == 20


@pytest.mark.slow
def test_a_sweep_is_flown_alike(updated, two_workers, monkeypatch):
    monkeypatch.setattr(simulation, "MAX_LANES", 4)

    def flown():
        grid = {"motor_constant": np.linspace(1.3e-5, 1.6e-5, 10)}
        shape = TrajectorySettings(name="circle")
        return list(simulate(updated, ControllerFile(), shape, duration=1.0, grid=grid))

    here = flown()
    with using(two_workers):
        there = flown()
    assert [f.coefficients for f in there] == [f.coefficients for f in here]
    for one, other in zip(there, here, strict=True):
        same(one.signals, other.signals)


def table_of(job, folder, on_iteration=lambda _: None):
    folder.mkdir()
    cross_validate(*job, folder, on_iteration)
    return (folder / CROSS_VALIDATION_FILE).read_text()


@pytest.fixture(scope="module")
def folds_here(two_flights, tmp_path_factory):
    stages = []
    folder = tmp_path_factory.mktemp("folds") / "here"
    table = table_of(two_flights, folder, lambda now: stages.append(now.stage))
    assert {stage.partition(",")[0] for stage in stages} == {"without one", "without two"}
    return table, set(stages)


@pytest.mark.slow
def test_folds_are_the_same_elsewhere(two_flights, two_workers, folds_here, tmp_path):
    heard = []
    with using(two_workers):
        there = table_of(two_flights, tmp_path / "there", lambda now: heard.append(now.stage))
    assert there == folds_here[0]
    assert set(heard) == folds_here[1]


@pytest.mark.slow
def test_bootstrap_refits_are_the_same_elsewhere(two_flights, two_workers, tmp_path):
    def table(folder):
        folder.mkdir()
        errors = bootstrap(*two_flights, 3, folder, lambda _: None)
        assert set(errors) == set(FREE)
        return (folder / BOOTSTRAP_FILE).read_text()

    here = table(tmp_path / "here")
    with using(two_workers):
        assert table(tmp_path / "there") == here


@pytest.mark.slow
@pytest.mark.parametrize(
    "moment", [0, *(pytest.param(moment, marks=pytest.mark.long) for moment in range(1, 20))]
)
def test_folds_are_the_same_though_a_worker_is_lost(
    two_flights, two_workers, folds_here, tmp_path, moment
):
    workers = {one["pid"] for one in two_workers.map(tasks.about_the_process, range(8))}
    seconds = np.random.default_rng(moment).uniform(0.0, 3.0)
    killing = threading.Timer(seconds, os.kill, (max(workers), signal.SIGKILL))
    with using(two_workers):
        killing.start()
        there = table_of(two_flights, tmp_path / "there")
    killing.join()
    assert there == folds_here[0]

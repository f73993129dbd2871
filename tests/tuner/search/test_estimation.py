"""What a search starts from, and when it asks for a second opinion."""

import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from tests.tuner.uncertainty.making import FLIGHTS, NOISE, fitted_of, problem, truth
from tuner.config import JobFile, Search, resolve_settings
from tuner.core.errors import InputError
from tuner.findings.findings import Code, Finding, sentence
from tuner.objective.criterion import Point
from tuner.objective.space import space_of
from tuner.options import Options
from tuner.recordings.notes import NoteCode
from tuner.search import estimation
from tuner.search import estimation as module
from tuner.search.estimation import fingerprint, load, polished, save, starting_vectors
from tuner.search.findings import (
    outlying_flights,
    reference_voltage_findings,
    unmatched,
    unmatched_findings,
)
from tuner.search.listener import Outcome
from tuner.search.progress import Loop, initial_progress, loop_of, with_loop
from tuner.search.stages import plan, remaining_seconds
from tuner.uncertainty.estimates import finer_than_steps
from tuner.vehicle import ControllerFile

FREE = ("inertia_xx", "motor_constant", "estimate_latency")


@pytest.fixture(scope="module")
def fitted():
    fit = problem(FREE)
    return fitted_of(fit, truth(fit))


def job_with(updated, **search):
    settings = SimpleNamespace(job=JobFile(free=FREE, search=Search(**search)))
    return SimpleNamespace(
        settings=settings,
        space=space_of(updated, ControllerFile(), settings.job),
        inlets=("reference", "reference"),
        fitted=("a", "b"),
    )


def test_random_starts_lie_in_the_box_and_the_first_is_the_vehicles(updated):
    job = job_with(updated, starts=50, spread=3.0)
    vectors = starting_vectors(job)
    assert vectors.shape == (50, 3)
    np.testing.assert_allclose(vectors[0], job.space.initial)
    values = [job.space.numbers(vector) for vector in vectors]
    drawn = np.array([float(drawn_values["motor_constant"]) for drawn_values in values])
    initial = job.space.parameters[job.space.names.index("motor_constant")].initial
    ratio = drawn / initial
    assert 1 / 3.01 < ratio.min() < 0.5
    assert 2.0 < ratio.max() < 3.01
    np.testing.assert_array_equal(vectors, starting_vectors(job))
    reseeded = job_with(updated, starts=50, spread=3.0, seed=1)
    assert not np.array_equal(vectors[1:], starting_vectors(reseeded)[1:])


def test_starts_that_agree_are_believed(fitted, updated):
    job = job_with(updated, starts=4)
    agree = replace(fitted, outcomes=ends(1.0, 1.001, 7.0, 9.0))
    assert module._doubt(job, agree) is None
    differ = replace(fitted, outcomes=ends(1.0, 1.3, 7.0, 9.0))
    doubt = module._doubt(job, differ)
    assert (doubt.code, doubt.numbers) == (Code.STARTS_DISAGREE, {"starts": 4})


def test_flights_that_stay_far_off_cause_a_second_search(fitted, updated):
    job = job_with(updated)
    lost = {"a": {"position": 50.0, "body_rate": 30.0}, "b": {"position": 40.0, "body_rate": 3.0}}
    assert module._doubt(job, replace(fitted, scales=lost, outcomes=ends(1.0))) is None
    lost["b"]["body_rate"] = 12.0
    doubt = module._doubt(job, replace(fitted, scales=lost, outcomes=ends(1.0)))
    assert (doubt.code, doubt.numbers) == (Code.FLIGHTS_FAR_OFF, {"far_off": 2, "flights": 2})


def ends(*losses):
    return tuple(Outcome(origin="random", loss=loss, start={}, end={}) for loss in losses)


def test_findings_are_those_of_the_last_polish(fitted, updated, monkeypatch):
    """A flight that a term was missing for is matched with it, and the warning goes."""
    job = job_with(updated)
    job.settings.controller = ControllerFile()
    job.fitted = [SimpleNamespace(name=name, series={}, notes=()) for name in fitted.scales]
    missed = Finding(Code.FLIGHT_UNMATCHED, "warning", "spin", {"position": 30.0})
    doubt = Finding(Code.STARTS_DISAGREE, "info", "search", {"starts": 3})
    asked = []

    def stages_run(_, __, progress, **given):
        asked.append(given["clocks_are_late"])
        return progress

    monkeypatch.setattr(module, "run_stages", stages_run)
    free = Point(np.ones(len(FREE), bool), np.ones(np.shape(fitted.point.offsets), bool))
    matched = replace(fitted, findings=(missed, doubt))
    again = polished(job, matched, free=free, title="again", on_progress=lambda _: None)
    assert again.findings == (doubt,)
    job.fitted[0].notes = (NoteCode.POSE_MOVED.note(seconds=-0.02),)  # onto a gyro that is late
    polished(job, matched, free=free, title="again", on_progress=lambda _: None)
    assert asked == [False, True]
    scales = {**fitted.scales, "spin": dict.fromkeys(fitted.scales["spin"], 30.0)}
    lost = replace(matched, scales=scales)
    again = polished(job, lost, free=free, title="again", on_progress=lambda _: None)
    assert [finding.code for finding in again.findings] == [doubt.code, Code.MODEL_UNMATCHED]


def test_an_outlying_flight_is_named_and_a_misfit_of_all_is_the_models():
    one_stray = {"a": {"position": 1.0}, "b": {"position": 1.1}, "c": {"position": 90.0}}
    assert set(unmatched(one_stray)) == outlying_flights(one_stray) == {"c"}
    assert not outlying_flights(one_stray | {"b": {"position": 1.5}})
    assert not outlying_flights({name: one_stray[name] for name in "ac"})
    (finding,) = unmatched_findings(one_stray)
    assert (finding.code, finding.subject) == (Code.FLIGHT_UNMATCHED, "c")
    all_far = {"a": {"position": 30.0}, "b": {"position": 40.0}, "c": {"position": 35.0}}
    (finding,) = unmatched_findings(all_far)
    assert finding.code is Code.MODEL_UNMATCHED
    assert finding.numbers == {"unmatched": 3, "flights": 3, "noise_multiple": 35.0}


def test_a_lag_known_more_finely_than_physics_steps_is_warned_of():
    estimates = {
        name: SimpleNamespace(std_error=error)
        for name, error in {
            "time_constant_up": 2e-5,
            "time_constant_down": 5e-4,
            "motor_constant": 1e-9,
        }.items()
    }
    (finding,) = finer_than_steps(SimpleNamespace(estimates=estimates))
    assert finding.subject == "time_constant_up"
    assert finding.numbers == {"seconds": 1e-4}
    estimates["time_constant_up"] = SimpleNamespace(std_error=2e-4)
    assert not list(finer_than_steps(SimpleNamespace(estimates=estimates)))


def test_a_curve_of_motors_says_at_which_voltage_it_holds(updated):
    best = updated.replace(
        effects={"battery_exponent": 1.0}, battery=updated.battery.replace(reference_voltage=16.36)
    )
    (finding,) = reference_voltage_findings(updated, best)
    assert "16.36 V" in sentence(finding)
    assert not list(reference_voltage_findings(best, best))  # given
    assert not list(reference_voltage_findings(updated, best.replace(effects={})))


def test_time_left_falls_to_nothing():
    stages = plan("gradient", 4000, 400.0, windows=False, robust=True, steps=50)
    remaining = [remaining_seconds(stages, stage, 0, 10.0) for stage in range(1, len(stages) + 1)]
    assert remaining == sorted(remaining, reverse=True)
    assert remaining[-1] == 0.0
    assert np.isnan(remaining_seconds(stages, 0, 0, 0.0))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("coefficients", np.zeros((1, 7))),
        ("coefficients", np.full((1, 3), np.nan)),
        ("offsets", np.array([["x"]])),
        ("scales", np.zeros((1, 1))),
        ("losses", np.zeros(9)),
        ("states", np.zeros(4)),
        ("head", np.frombuffer(b"[" * 100_000, np.uint8)),
    ],
)
def test_a_checkpoint_that_was_changed_is_not_gone_on_from(fitted, tmp_path, name, value):
    path = tmp_path / "checkpoint.npz"
    start = initial_progress(fitted.objective, fitted.point.coefficients[None])
    save(path, "key", start, 2.0)
    again, seconds = load(path, "key", start)
    assert (again.points.coefficients == start.points.coefficients).all()
    assert seconds == 2.0
    save(path, "key", replace(start, converged=True), 2.0)
    assert load(path, "key", start)[0].converged
    with np.load(path) as arrays:
        np.savez(path, **(dict(arrays) | {name: value}))
    with pytest.raises(InputError, match=r"checkpoint\.npz: is no checkpoint"):
        load(path, "key", start)


def test_a_checkpoint_is_of_flights_that_are_read_alike(bag, tmp_path):
    recording = shutil.copy(bag, tmp_path / "flight.bag")
    (tmp_path / "own.yaml").write_text("name: own\nformat: ros\nextends: mavros\nsignals: {}\n")

    def digest(topics=None):
        settings = resolve_settings(Options([str(recording)], topics=topics))
        flight = SimpleNamespace(
            name="flight", sha256="0", path=str(recording), series={}, notes=()
        )
        return fingerprint(SimpleNamespace(settings=settings, flights=[flight]))

    own, before = digest(str(tmp_path / "own.yaml")), digest()
    assert digest() == before
    (tmp_path / "own.yaml").write_text("name: other\nformat: ros\nextends: mavros\nsignals: {}\n")
    assert digest(str(tmp_path / "own.yaml")) != own
    (tmp_path / "flight.yaml").write_text("start: 1.0\n")
    assert digest() != before


# what a search that is done again forgets, and what it keeps

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
        fitted=[SimpleNamespace(name=name, series={}, notes=()) for name in FLIGHTS],
        undecided=lambda _: {choice: tell},
    )
    asked = {}

    def grown(_, __, progress, *, undecided, overruled, **___):
        asked.update(undecided=undecided, loop=progress.loop, overruled=overruled)
        scales = {name: np.ones(len(FLIGHTS)) for name in NOISE}
        loop = own.switched(choice)
        return replace(progress, loop=loop, scales=scales, losses=np.ones(1))

    monkeypatch.setattr(estimation, "run_stages", grown)
    free = Point(np.ones(3, bool), np.zeros(fitted.point.offsets.shape, bool))
    said = {"free": free, "title": "again", "on_progress": lambda _: None}
    again = estimation.polished(
        job, fitted, start=objective.space.initial, stages=estimation.ALL_BUT_LAST, **said
    )
    assert asked == {"undecided": {choice: tell}, "loop": own, "overruled": [choice]}
    assert loop_of(again.objective) == own.switched(choice)
    estimation.polished(job, again, **said)
    assert (asked["undecided"], asked["loop"]) == ({}, own.switched(choice))


@pytest.mark.parametrize(("left", "steps"), [(None, 2), (1e-3, 1)])
def test_a_rough_fit_ends_where_a_linear_step_is_left(left, steps):
    """From where noise alone is left a step gains less than a thousandth of the loss."""
    objective = problem(PLAIN, seed=0)
    true = np.array(truth(objective).coefficients)
    fitted = fitted_of(objective, objective.start(true + 0.02 * true))
    job = SimpleNamespace(
        objective=objective,
        settings=SimpleNamespace(job=JobFile(), controller=ControllerFile()),
        fitted=[SimpleNamespace(name=name, series={}, notes=()) for name in FLIGHTS],
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


def test_what_is_held_keeps_its_value_and_the_others_are_fitted():
    objective = problem(PLAIN, seed=0)
    start = 1.02 * np.array(truth(objective).coefficients)
    job = SimpleNamespace(
        objective=objective,
        space=objective.space,
        settings=SimpleNamespace(job=JobFile(), controller=ControllerFile()),
        fitted=[SimpleNamespace(name=name, series={}, notes=()) for name in FLIGHTS],
        inlets=("reference", "reference"),
        recordings=[SimpleNamespace(time_offset=0.0, holdout=False)] * 2,
    )
    again = estimation.polished(
        job,
        fitted_of(objective, objective.start(start)),
        free=estimation.free_parameters(job, held=("inertia_xx",)),
        title="again",
        on_progress=lambda _: None,
        stages=estimation.FIRST_POLISH,
    )
    moved = again.point.coefficients != start
    assert dict(zip(objective.space.names, moved, strict=True)) == {
        name: name != "inertia_xx" for name in PLAIN
    }


def test_long_stages_before_the_polish_end_early_where_flights_stay_far_off():
    stages = plan("gradient", 4000, 400.0, windows=False, robust=True, steps=9)
    early = estimation.with_far_off_tolerance(stages)
    long = {"first 5 s", "first 8 s", "whole length"}
    assert {stage.name for stage in early if stage.far_off_tolerance} == long
    assert [replace(stage, far_off_tolerance=0.0) for stage in early] == list(stages)


@pytest.mark.parametrize("own", [Loop(0.0, 1.0), Loop(1.0, 0.0)])
def test_a_search_begins_with_the_set_ups_own_loop(own):
    objective = with_loop(problem(PLAIN), own)
    assert initial_progress(objective, np.asarray(objective.space.initial)[None]).loop == own

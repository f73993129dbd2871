"""The whole job on the shipped recordings, held against the truth that they were flown with."""

import csv
import io
import json
import re
import shutil
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from markupsafe import escape

from tuner.cli import main
from tuner.cli.results import LINES, WIDTH, print_run
from tuner.core.errors import InputError
from tuner.evaluate.comparison import Comparison
from tuner.findings.findings import Code, sentence
from tuner.job import run as module
from tuner.job.run import run
from tuner.options import Options
from tuner.recordings.loader import load_flight
from tuner.recordings.notes import Cause
from tuner.report import render
from tuner.report.contents import SearchRecord
from tuner.result import OF_A_RUN, read_run
from tuner.search.job_flights import JobFlight
from tuner.search.listener import Listener, PointEstimate
from tuner.vehicle import ControllerFile, read_controller, read_vehicle, values_of

FLIGHTS = Path(__file__).parents[3] / "reference_flights"
MECHANICAL = (
    "inertia_xx",
    "inertia_yy",
    "inertia_zz",
    "input_scaling",
    "zero_position_armed",
    "motor_constant",
    "moment_constant",
    "rotor_drag_coefficient",
)


@pytest.fixture(scope="module")
def truth():
    return yaml.safe_load((FLIGHTS / "truth.yaml").read_text())


@pytest.fixture(scope="module")
def finished(demo):
    return demo


@pytest.mark.slow
@pytest.mark.parametrize("name", MECHANICAL)
def test_mechanical_coefficients_within_one_percent(finished, truth, name):
    assert finished[1].coefficients[name].best == pytest.approx(truth[name], rel=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["time_constant_up", "time_constant_down"])
def test_time_constants_within_four_percent(finished, truth, name):
    assert finished[1].coefficients[name].best == pytest.approx(truth[name], rel=0.04)


@pytest.mark.slow
def test_estimate_latency_within_half_a_millisecond(finished, truth):
    latency = finished[1].coefficients["estimate_latency"].best
    assert latency == pytest.approx(truth["estimate_latency"], abs=5e-4)


@pytest.mark.slow
def test_a_profile_names_every_stage(finished):
    folder, _ = finished
    rows = csv.DictReader(io.StringIO((folder / "profile.csv").read_text()))
    seconds = {row["stage"]: float(row["seconds [s]"]) for row in rows}
    assert {"reading", "check", "search", "selection of terms", "examination"} <= set(seconds)
    assert {"validation", "results", "next flight", "page", "exports"} <= set(seconds)
    assert seconds["elsewhere"] < 0.1 * sum(seconds.values())


@pytest.mark.slow
def test_the_held_out_flight_is_met_to_its_measurement_noise(finished):
    (held,) = [flight for flight in finished[1].flights if flight.split == "holdout"]
    assert held.name == "circle_4mps"
    for axis in ("x", "y", "z"):
        before, after = getattr(held.rmse_initial, axis), getattr(held.rmse_best, axis)
        assert after < 0.0007
        assert after < before / 50


@pytest.mark.slow
def test_mass_and_rolling_moment_stay_as_given(finished):
    for name in ("mass", "rolling_moment_coefficient"):
        coefficient = finished[1].coefficients[name]
        assert not coefficient.fitted
        assert coefficient.best == coefficient.initial


@pytest.mark.slow
@pytest.mark.usefixtures("terminal")
def test_the_terminal_says_in_thirty_lines_that_it_can_be_used(finished, capsys):
    print_run(*finished, seconds=40.0)
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= LINES
    assert [line for line in lines if len(line) > WIDTH and str(finished[0]) not in line] == []
    assert lines[0].startswith("Usable. 12 coefficients were fitted to 4 simulated flights")
    (held,) = (line for line in lines if line.startswith("circle_4mps, held out"))
    assert held.split()[-1] == "matched"
    assert sum(line.startswith("! ") for line in lines) == 2
    assert "Terms: none of" in "\n".join(lines)


@pytest.mark.slow
def test_nothing_is_said_to_lack_where_the_model_is_the_one_that_flew(finished):
    """Though set-points, gyro and commands are recorded at other rates than simulated ones."""
    result = finished[1]
    lacking = ("law_lacking", "controller_answers", "rotor_speeds_late", "rotor_changed")
    assert not [finding for finding in result.findings if finding.code in lacking]
    fitted = [row for row in result.coefficients.values() if row.fitted]
    assert not [row for row in fitted if row.std_error_parts.lack]


def test_no_term_is_added_to_flights_that_lack_none(finished):
    table = finished[1].selection
    assert len(table) > 5
    assert not any(row.kept for row in table)


@pytest.mark.slow
def test_the_set_ups_integrator_is_identified_and_reported(finished):
    codes = [finding.code for finding in finished[1].findings]
    assert codes.count(Code.SATURATION_FEEDBACK) == 1
    assert finished[1].settings["controller"]["mixer"]["saturation_feedback"] is False


@pytest.mark.slow
def test_the_folder_holds_what_later_commands_read(finished):
    folder, result = finished
    files = {path.name for path in folder.iterdir() if path.is_file() if path.suffix != ".npz"}
    assert files <= set(OF_A_RUN)
    vehicle = read_vehicle(folder / "best_fit.yaml")
    for name, value in values_of(vehicle).items():
        assert value == result.coefficients[name].best
    controller = ControllerFile.model_validate(result.settings["controller"])
    assert read_controller(folder / "controller.yaml") == controller
    assert json.loads((folder / "result.json").read_text())["status"] == "converged"
    assert len((folder / "metrics.csv").read_text().splitlines()) == 1 + 6 * 5
    page = render(folder).read_text()
    assert len(page) < 5_000_000
    outside = re.compile(r"(?:src|href|action)\s*=\s*[\"']?\s*(?:https?:)?//|url\(\s*[\"']?https?:")
    assert not outside.search(page.split('id="library"')[0])
    assert "circle_4mps" in page


@pytest.mark.slow
def test_a_run_started_from_best_fit_starts_where_the_fit_ended(finished):
    folder, result = finished
    controller = ControllerFile.model_validate(result.settings["controller"])
    recordings = [
        JobFlight(load_flight(flight.path), time_offset=flight.time_offset)
        for flight in result.flights
    ]
    flown = Comparison(recordings, controller).fly(read_vehicle(folder / "best_fit.yaml"))
    for flight in result.flights:
        for axis, value in flight.rmse_best:
            assert getattr(flown[flight.name].rmse, axis) == pytest.approx(value, rel=1e-9)


NO_TERMS = str(Path(__file__).with_name("no_terms.yaml"))
SHORT = {
    "fit": ["inertia_zz", "moment_constant"],
    "vehicle": "hovergames_updated",
    "config": NO_TERMS,
}


def short_job():
    return Options([str(FLIGHTS / "yaw_spin_3rps.bag")], **SHORT)


@pytest.mark.long
@pytest.mark.slow
def test_refits_to_other_flights_predict_give_errors_and_leave_the_fit(tmp_path):
    bags = [str(FLIGHTS / f"{name}.bag") for name in ("yaw_spin_3rps", "circle_3mps")]
    folder, result = run(
        Options(bags, cross_validate=True, bootstrap=3, **SHORT), out=tmp_path / "run"
    )
    rows = [line.split(",") for line in (folder / "cross_validation.csv").read_text().splitlines()]
    assert [row[0] for row in rows] == ["left_out", "yaw_spin_3rps", "circle_3mps", "spread"]
    column = rows[0].index("moment_constant")
    values = [float(row[column]) for row in rows[1:3]]
    assert values[0] != values[1]
    assert float(rows[3][column]) == pytest.approx(np.std(values, ddof=1))
    written = values_of(read_vehicle(folder / "best_fit.yaml"))
    assert written["moment_constant"] == result.coefficients["moment_constant"].best
    found = read_run(folder).result.coefficients["moment_constant"]
    assert found.jackknife_error == pytest.approx(abs(values[0] - values[1]) / 2)
    drawn = list(csv.DictReader((folder / "bootstrap.csv").read_text().splitlines()))
    for row in drawn:
        assert int(row["drawn_yaw_spin_3rps"]) + int(row["drawn_circle_3mps"]) == 2
    refits = [float(row["moment_constant"]) for row in drawn]
    assert found.bootstrap_error == pytest.approx(np.std(refits, ddof=1))
    assert "Refits to other flights" in (folder / "report.html").read_text()


@pytest.fixture(scope="module")
def broken(tmp_path_factory):
    """A recording whose file lacks its end and its index."""
    path = tmp_path_factory.mktemp("broken") / "cut.bag"
    whole = (FLIGHTS / "yaw_spin_3rps.bag").read_bytes()
    path.write_bytes(whole[: 2 * len(whole) // 3])
    return path


@contextmanager
def nothing_proposed():
    """Leave out what to fly next, which runs of whole flights show."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tuner.job.run.write_next_flight", lambda *_: None)
        yield


@pytest.fixture(scope="module")
def salvaged(broken, tmp_path_factory):
    """A run that the command made of it, and what it printed meanwhile."""
    out = tmp_path_factory.mktemp("salvaged") / "run"
    words = ["--flights", str(broken), "--fit", *SHORT["fit"], "--vehicle", SHORT["vehicle"]]
    words += ["--config", NO_TERMS]
    printed = io.StringIO()
    with nothing_proposed(), redirect_stdout(printed), redirect_stderr(printed):
        status = main([*words, "--out", str(out), "--quiet"])
    return status, printed.getvalue(), read_run(out)


@pytest.mark.slow
def test_what_was_salvaged_is_said_by_result_and_page_even_of_a_quiet_run(salvaged):
    status, printed, whole = salvaged
    assert (status, printed) == (0, "")
    found = [finding for finding in whole.result.findings if finding.code is Code.SALVAGED]
    assert {finding.subject for finding in found} == {"cut"}
    assert {finding.names[0] for finding in found} <= set(Cause)
    assert sum(finding.numbers.get("salvaged", 0) for finding in found) > 5_000
    page = (whole.folder / "report.html").read_text()
    for finding in found:
        assert str(escape(sentence(finding))) in page


@pytest.mark.slow
def test_a_spin_alone_has_no_position_error(salvaged):
    iterations = SearchRecord.read(salvaged[2].folder).iterations
    assert {iteration.position_rmse for iteration in iterations} == {None}


def test_the_best_vehicle_so_far_is_written_once_a_second_and_on_a_stop(tmp_path, monkeypatch):
    file = read_vehicle(FLIGHTS.parent / "configs" / "vehicles" / "crazyflie.yaml")
    space = SimpleNamespace(numbers=lambda vector: {"mass": float(vector[0])})
    job = SimpleNamespace(space=space, settings=SimpleNamespace(vehicle=file))
    clock = [5.0]
    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: clock[0]))
    best = module._BestSoFar(tmp_path / "best_fit.yaml")
    best.write()
    assert not best.path.exists()  # nothing was found yet

    def kept(mass: float, *, after: float) -> float:
        clock[0] += after
        point = SimpleNamespace(coefficients=np.array([mass]))
        best.keep(job, SimpleNamespace(best_point=point))
        return read_vehicle(best.path).mass

    assert [kept(1.0, after=0.0), kept(2.0, after=0.5), kept(3.0, after=0.6)] == [1.0, 1.0, 3.0]
    assert kept(4.0, after=0.9) == 3.0
    best.rescue()
    assert read_vehicle(best.path).mass == 4.0


@pytest.mark.slow
def test_an_interrupted_run_goes_on_elsewhere_to_the_same_numbers(broken, salvaged, tmp_path):
    whole = salvaged[2].result
    iterations = []

    def interrupt(*what):
        iterations.append(what)
        if len(iterations) == 7:
            raise KeyboardInterrupt

    job = Options([str(broken)], **SHORT)
    (tmp_path / "cut").mkdir()
    (tmp_path / "cut" / "result.json").write_text('{"schema_version": 1}')
    with pytest.raises(KeyboardInterrupt):
        run(job, out=tmp_path / "cut", listener=Listener(on_iteration=interrupt))
    assert (tmp_path / "cut" / "best_fit.yaml").exists()
    assert not (tmp_path / "cut" / "result.json").exists()
    elsewhere = tmp_path / "another machine"
    elsewhere.mkdir()
    shutil.move(tmp_path / "cut", elsewhere)
    job = Options([str(shutil.copy(broken, elsewhere))], **SHORT)
    reported = []
    listener = Listener(on_estimates=reported.extend, on_message=reported.append)
    with nothing_proposed():
        _, resumed = run(job, out=elsewhere / "cut", resume=True, listener=listener)
    for name, coefficient in whole.coefficients.items():
        assert resumed.coefficients[name].best == coefficient.best
    # where the search ended is reported before it is examined, and no term moves it here
    examining = next(i for i, each in enumerate(reported) if str(each).startswith("Examining"))
    estimates = {e.name: e for e in reported[:examining] if isinstance(e, PointEstimate)}
    assert set(estimates) == set(SHORT["fit"])
    for name, estimate in estimates.items():
        coefficient = whole.coefficients[name]
        assert (estimate.initial, estimate.estimate) == (coefficient.initial, coefficient.best)
    assert resumed.search.evaluations == whole.search.evaluations


@pytest.mark.parametrize("begun", [True, False])
def test_whatever_is_interrupted_says_how_to_go_on(begun, tmp_path, monkeypatch):
    def stopped(run, *_: object, **__: object) -> None:
        if begun:
            (run.folder / "checkpoint.npz").touch()
        raise KeyboardInterrupt

    monkeypatch.setattr(module._Run, "fit", stopped)
    said = []
    with pytest.raises(KeyboardInterrupt):
        run(short_job(), out=tmp_path / "cut", listener=Listener(on_stop=said.append))
    go_on = f"Continue with --out {tmp_path / 'cut'} --resume."
    assert [line.rpartition(". ")[2] for line in said] == [go_on] * begun


def test_resume_without_a_checkpoint_is_refused(tmp_path):
    with pytest.raises(InputError, match="--out"):
        run(short_job(), resume=True)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("asked", [{"cross_validate": True}, {"bootstrap": 5}])
def test_refits_to_a_single_flight_are_refused_before_the_search(tmp_path, asked):
    with pytest.raises(InputError, match="give two or more"):
        run(Options([str(FLIGHTS / "yaw_spin_3rps.bag")], **asked), out=tmp_path / "r")
    assert not (tmp_path / "r").exists()


def test_a_missing_flight_writes_nothing(tmp_path):
    with pytest.raises(InputError, match="nowhere"):
        run(Options(["nowhere/*.bag"]), out=tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_the_check_sees_that_nothing_moves():
    from tuner.job.prepare import singular_directions  # noqa: PLC0415

    towards = np.array([[1.0, 1.0], [1.0, 1.0 + 1e-9]])
    (direction,) = singular_directions(towards)
    assert direction[0] == pytest.approx(-direction[1], rel=1e-3)
    assert singular_directions(np.eye(2)) == []

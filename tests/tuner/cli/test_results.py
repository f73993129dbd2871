"""A finished job on a terminal: thirty lines of a hundred columns, and all of it if asked."""

import re

import pytest

from tests.tuner.exporters.conftest import make_run  # noqa: F401 (a fixture)
from tests.tuner.findings.test_findings import MADE
from tests.tuner.report import making
from tests.tuner.report.conftest import FREE, ROLLING
from tuner.cli.results import LINES, WIDTH, print_run
from tuner.evaluate.records import AxesRmse
from tuner.findings.findings import Code, Finding, one_line
from tuner.result import read_run
from tuner.vehicle import COEFFICIENTS


@pytest.fixture
def folder(tmp_path, terminal):  # noqa: ARG001 (a fixture that acts)
    making.write_run(tmp_path, FREE, ROLLING)
    return tmp_path


def lines_of(folder, result, capsys, **how):
    print_run(folder, result, **how)
    return capsys.readouterr().out.splitlines()


def test_a_finished_job_says_what_the_issue_lists(folder, capsys):
    lines = lines_of(folder, read_run(folder).result, capsys, seconds=41.7)
    text = "\n".join(lines)
    assert len(lines) <= LINES
    assert max(map(len, lines)) <= WIDTH or str(folder) in max(lines, key=len)
    assert "7 coefficients were fitted to 1 flight; 1 was held out to check them." in lines[0]
    (held,) = (line for line in lines if line.startswith("spin, held out"))
    assert "→" in held
    assert held.split()[-1] in ("matched", "better", "unchanged")
    assert "Terms: fuselage_drag of 2 kept." in text
    mass = r"^Fixed: mass [0-9.]+ kg \(forces, drag and inertia go with it\), "
    assert re.search(mass, text, re.MULTILINE)
    assert f"Written to {folder} in 42 s" in text
    assert lines[-1].startswith("Next: ")


def test_many_warnings_and_coefficients_still_fit(folder, capsys):
    result = read_run(folder).result
    many = dict.fromkeys(COEFFICIENTS, result.coefficients["inertia_xx"])
    findings = tuple(
        Finding(made.code, "warning", f"a flight with a rather long name, {made.subject}",
                made.numbers, made.names)
        for made in MADE.values()
        if made.code is not Code.TERM_SHOWS  # its subject is a term
    )  # fmt: skip
    flights = tuple(
        result.flights[1].model_copy(update={"name": f"held_{number}"}) for number in range(9)
    )
    update = {"coefficients": many, "findings": findings, "flights": flights}
    lines = lines_of(folder, result.model_copy(update=update), capsys)
    assert len(lines) <= LINES
    assert [line for line in lines if len(line) > WIDTH and str(folder) not in line] == []
    assert sum(line.startswith("! ") for line in lines) == 7


def test_a_pipe_gets_whole_lines(folder, capsys, monkeypatch):
    monkeypatch.setenv("TTY_COMPATIBLE", "0")
    monkeypatch.setenv("FORCE_COLOR", "")
    result, name = read_run(folder).result, "a_flight_with_a_long_name_" * 12
    finding = Finding(Code.SETPOINTS_SCALED, "warning", name, {"gain": 0.2, "correlation": 0.9},
                      ("roll", ""))  # fmt: skip
    flights = (result.flights[1].model_copy(update={"name": name}),)
    update = {"findings": (finding,), "flights": flights}
    lines = lines_of(folder, result.model_copy(update=update), capsys)
    assert "! " + one_line(finding).removeprefix("warning: ") in lines
    assert any(line.startswith(f"{name}, held out") for line in lines)
    assert not any("…" in line for line in lines)


def test_verbose_adds_what_the_page_says(folder, capsys):
    result = read_run(folder).result
    short = lines_of(folder, result, capsys)
    long = lines_of(folder, result, capsys, verbose=True)
    assert long[-len(short) :] == short
    text = "\n".join(long)
    for said in ("RMSE axis by axis", "Open-loop predictions", "What to log next time",
                 "In Gazebo", "Terms beyond the motor model"):  # fmt: skip
        assert said in text


def test_a_followed_attitude_is_no_crash(folder, capsys):
    result = read_run(folder).result
    met = AxesRmse(x=0.01, y=0.02, z=0.03, roll=None, pitch=None, yaw=None)
    crashed = AxesRmse(x=None, y=None, z=None, roll=None, pitch=None, yaw=None)
    followed = result.flights[1].model_copy(
        update={"name": "followed", "rmse_initial": met, "rmse_best": met}
    )
    fell = result.flights[1].model_copy(update={"name": "fell", "rmse_best": crashed})
    lines = lines_of(folder, result.model_copy(update={"flights": (followed, fell)}), capsys)
    (row,) = (line for line in lines if line.startswith("followed"))
    assert "–" in row
    assert "crash" not in row
    (row,) = (line for line in lines if line.startswith("fell"))
    assert row.split()[-1] == "crashes"

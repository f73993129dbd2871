"""`tune new-vehicle`: near two known vehicles, with priors as wide as the laws are crude."""

import math

import pytest

from tuner.cli import main
from tuner.config import read_job
from tuner.core.shipped import configs_folder
from tuner.vehicle import read_vehicle, values_of
from tuner.vehicle.scaling_laws import KNOWN_AIRFRAMES, scaled_coefficients

QUAD = ["--mass", "2.243", "--wheelbase", "0.5", "--propeller", "11x4.7"]
PALM = ["--mass", "0.03", "--wheelbase", "0.092", "--propeller", "1.85x1.0"]
SHIPPED = {"hovergames": "hovergames_updated", "crazyflie": "crazyflie"}


def known(name):
    return values_of(read_vehicle(configs_folder() / "vehicles" / f"{SHIPPED[name]}.yaml"))


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ([*QUAD, "--cells", "4", "--motor-kv", "920"], "hovergames"),
        ([*QUAD, "--hover-throttle", "0.54"], "hovergames"),
        ([*QUAD], "hovergames"),
        ([*PALM, "--cells", "1", "--motor-kv", "14000"], "crazyflie"),
        ([*PALM, "--hover-throttle", "0.86"], "crazyflie"),
    ],
)
def test_the_laws_are_within_a_factor_of_two_of_known_vehicles(tmp_path, options, name):
    out = tmp_path / "quad.yaml"
    assert main(["new-vehicle", *options, "--out", str(out), "--quiet"]) == 0
    estimated, truth = values_of(read_vehicle(out)), known(name)
    for coefficient in scaled_coefficients(KNOWN_AIRFRAMES[name]):
        ratio = estimated[coefficient] / truth[coefficient]
        assert 0.499 < ratio < 2.001, coefficient


@pytest.mark.parametrize("name", KNOWN_AIRFRAMES)
def test_a_vehicle_like_itself_is_itself(tmp_path, name):
    out = tmp_path / "quad.yaml"
    assert main(["new-vehicle", "--like", name, "--out", str(out), "--quiet"]) == 0
    estimated, truth = values_of(read_vehicle(out)), known(name)
    for coefficient in scaled_coefficients(KNOWN_AIRFRAMES[name]):
        assert estimated[coefficient] == pytest.approx(truth[coefficient], rel=1e-3)


def test_the_job_file_holds_a_prior_as_wide_as_each_law(tmp_path):
    out = tmp_path / "quad.yaml"
    main(["new-vehicle", *QUAD, "--out", str(out), "--quiet"])
    job = read_job(tmp_path / "quad.job.yaml")
    assert job.mass == 2.243
    truth = known("hovergames")
    for name, settings in job.coefficients.items():
        prior = settings.prior
        assert settings.lower < prior.mean < settings.upper
        assert abs(math.log(truth[name] / prior.mean)) < 2 * prior.sd / prior.mean
    assert read_vehicle(out).source["motor_constant"].startswith("C_T ρ D⁴/(2π)²")


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--wheelbase", "0.5", "--propeller", "11x4.7"], "--mass: is missing"),
        (["--mass", "2243", "--wheelbase", "0.5", "--propeller", "11x4.7"], "0.01 to 100 kg"),
        (["--mass", "2.2", "--wheelbase", "500", "--propeller", "11x4.7"], "0.03 to 5 m"),
        (["--mass", "2.2", "--wheelbase", "0.5"], "--propeller: is missing"),
        (["--mass", "2.2", "--wheelbase", "0.5", "--propeller", "4.7x11"], "diameter and pitch"),
        ([*QUAD, "--hover-throttle", "54"], "0.05 to 0.95 of full command"),
        ([*QUAD, "--layout", "plus"], "the simulated mixer is that of the X"),
    ],
)
def test_bad_input_is_one_line_and_nothing_is_asked(
    tmp_path, capsys, monkeypatch, options, expected
):
    monkeypatch.setattr("builtins.input", lambda _: pytest.fail("asked"))
    assert main(["new-vehicle", *options, "--out", str(tmp_path / "quad.yaml")]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert expected in err
    assert not list(tmp_path.iterdir())


def test_the_folder_of_the_first_file_is_made(tmp_path):
    out = tmp_path / "runs" / "quad.yaml"
    assert main(["new-vehicle", "--like", "crazyflie", "--out", str(out)]) == 0
    assert read_vehicle(out).mass < 0.1


def test_no_file_that_is_there_is_replaced(tmp_path, capsys):
    (tmp_path / "quad.job.yaml").write_text("mine")
    assert main(["new-vehicle", *QUAD, "--out", str(tmp_path / "quad.yaml")]) == 2
    assert "quad.job.yaml: is there already" in capsys.readouterr().err
    assert [path.read_text() for path in tmp_path.iterdir()] == ["mine"]


@pytest.mark.parametrize("out", [".", "/"])
def test_a_folder_is_no_file(out, capsys):
    assert main(["new-vehicle", "--like", "crazyflie", "--out", out]) == 2
    assert "it is a folder; name a file" in capsys.readouterr().err


def test_a_terminal_is_asked_for_what_was_not_given(tmp_path, monkeypatch, capsys):
    answers = {"Mass": "2.243", "Distance": "0.5", "Cells": "", "kV": "", "Throttle": "0.54"}
    answers |= {"Propeller": "11x4.7", "Height": "0.06"}
    monkeypatch.setattr("builtins.input", lambda question: answers[question.split()[0].strip(",")])
    monkeypatch.setattr("sys.stdin.isatty", lambda: True)
    monkeypatch.setattr("sys.stdout.isatty", lambda: True, raising=False)
    out = tmp_path / "quad.yaml"
    assert main(["new-vehicle", "--out", str(out)]) == 0
    assert read_vehicle(out).mass == 2.243
    assert {rotor.position[2] for rotor in read_vehicle(out).rotors} == {0.06}
    assert "written to" in capsys.readouterr().out

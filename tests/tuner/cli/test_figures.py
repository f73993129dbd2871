"""Figures of single commands, and the page in the browser."""

import webbrowser

import pytest

from tests.tuner.report import making
from tests.tuner.report.conftest import FREE, ROLLING
from tuner.cli import main
from tuner.cli.app import WRONG_INPUT
from tuner.core.errors import InputError
from tuner.report.paper import check_figure, write_figure
from tuner.report.section import FITTED, Chart, Line, Panel

FLY = ["simulate", "--trajectory", "circle", "--duration", "4", "--quiet", "--out"]


@pytest.mark.parametrize(
    ("name", "begins"), [("c.png", b"\x89PNG"), ("c.svg", b"<?xml"), ("c.pdf", b"%PDF")]
)
def test_a_figure_is_what_its_file_ends_in(tmp_path, name, begins):
    chart = Chart("c", "a line", [Panel([Line("rising", [0.0, 1.0], [1.0, 2.0], FITTED)])])
    check_figure(tmp_path / name)
    write_figure(chart, tmp_path / name)
    once = (tmp_path / name).read_bytes()
    assert once.startswith(begins)
    write_figure(chart, tmp_path / name)
    assert (tmp_path / name).read_bytes() == once


def test_another_ending_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"cannot be written as '.jpg'; name one of .png"):
        check_figure(tmp_path / "c.jpg")


def test_a_flight_is_drawn_and_compared(tmp_path, capsys):
    bag, flown, compared = (tmp_path / name for name in ("c.bag", "c.png", "d.png"))
    assert main([*FLY, str(bag)]) == 0
    assert main([*FLY, str(flown)]) == 0
    words = ["compare", "--flights", str(bag), "--vehicle", "hovergames", "hovergames_updated"]
    assert main([*words, "--plot", str(compared)]) == 0
    assert flown.read_bytes().startswith(b"\x89PNG")
    assert compared.read_bytes().startswith(b"\x89PNG")
    assert f"written to {compared}" in capsys.readouterr().out


def test_a_figure_of_many_flights_is_refused_before_one_is_flown(tmp_path, capsys):
    sweep = ["--sweep", "motor_constant=1e-5:2e-5:3"]
    assert main([*FLY, str(tmp_path / "c.png"), *sweep]) == WRONG_INPUT
    assert "a figure is of one flight" in capsys.readouterr().err
    assert main(["compare", "--flights", "none.bag", "--vehicle", "x", "--plot", "c.txt"]) == 2
    assert "cannot be written as '.txt'" in capsys.readouterr().err


def test_the_page_is_opened_in_the_browser(tmp_path, monkeypatch, capsys):
    making.write_run(tmp_path, FREE, ROLLING)
    shown = []
    monkeypatch.setattr(webbrowser, "open", lambda address: shown.append(address) or True)
    assert main(["report", str(tmp_path), "--open"]) == 0
    assert shown == [(tmp_path / "report.html").as_uri()]
    monkeypatch.setattr(webbrowser, "open", lambda _: False)
    assert main(["report", str(tmp_path), "--open"]) == WRONG_INPUT
    assert "finds no browser here" in capsys.readouterr().err

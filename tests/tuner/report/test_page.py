"""The report as its readers see it: what it says, and that it draws in a browser."""

from __future__ import annotations

import html
import re
from pathlib import Path

import pytest

from tests.tuner.report import making
from tuner.core.errors import InputError
from tuner.report import render
from tuner.report.contents import read_contents
from tuner.report.sections.selection import selection
from tuner.uncertainty.directions import Direction

WITH_MASS = (
    "mass",
    "inertia_xx",
    "inertia_yy",
    "inertia_zz",
    "motor_constant",
    "moment_constant",
    "rotor_drag_coefficient",
    "rolling_moment_coefficient",
)


def words(page: Path) -> str:
    """Return what a reader reads, tags and scripts left out."""
    text = page.read_text().partition('<script id="figures"')[0]
    text = re.sub(r"<style>.*?</style>", " ", text, flags=re.DOTALL)
    return " ".join(html.unescape(re.sub(r"<[^>]*>", " ", text)).split())


def test_the_page_answers_what_a_reader_asks(report: Path) -> None:
    text = words(report)
    assert "on the held-out flights the position RMSE went from" in text
    assert "7 coefficients were fitted to 1 flight, of which the flights do not identify 1" in text
    assert "Gazebo cannot fly fuselage_drag" in text
    assert "rotor_drag_coefficient 0.000806 0.0009672 N s²/(rad m) +20 %" in text
    for heading in (
        "Coefficients",
        "In Gazebo",
        "Terms beyond the motor model",
        "RMSE of each flight",
        "Simulated against recorded",
        "Local sensitivity",
        "Information and correlation",
        "Residuals",
        "Search",
        "Provenance",
    ):
        assert heading in text
    assert "swing, lap 2" in text
    assert "3 → 1.25 (0.7500)" in text
    assert "What to log next time" in text
    assert "Log the command at 200 Hz" in text
    assert "Added to Gazebo's motor model: fuselage_drag." in text
    assert "well known" in text
    assert "ab" * 32 in text
    assert "multirotor-tune 0.1.0" in text


def test_the_page_is_one_file_without_the_network(report: Path) -> None:
    raw = report.read_text()
    assert report.stat().st_size < 5_000_000
    head = re.sub(r' src="data:[^"]*"', "", raw.partition('<script id="figures"')[0])
    assert not re.search(r'(src|href)="(?!#|data:)', head)
    assert "@import" not in head
    assert "url(" not in head


def test_what_a_user_typed_stays_text(report: Path) -> None:
    assert making.COMMAND in words(report)
    assert making.COMMAND not in report.read_text()


def test_the_main_figures_are_written_for_papers(report: Path) -> None:
    names = {path.name for path in (report.parent / "plots").iterdir()}
    assert {"swing_position.svg", "correlation.svg", "sensitivity.svg", "waterfall.svg"} <= names
    assert b"inertia_xx" in (report.parent / "plots" / "correlation.svg").read_bytes()


def test_the_same_folder_renders_the_same_page_and_figures(report: Path) -> None:
    files = [report, *sorted((report.parent / "plots").iterdir())]
    before = [file.read_bytes() for file in files]
    render(report.parent)
    assert [file.read_bytes() for file in files] == before


def test_a_freed_mass_is_named_as_the_scale_that_no_flight_shows(tmp_path: Path) -> None:
    scale = dict.fromkeys(("mass", "inertia_xx", "motor_constant"), 1.0)
    making.write_run(
        tmp_path, WITH_MASS, Direction(moves=scale, error=20.0, null=True, common_scale=True)
    )
    text = words(render(tmp_path))
    assert "scale together: multiplied by one factor, every motion stays the same" in text
    assert "Weigh the mass and fix it" in text
    mass = text.partition("take-off mass")[2].partition("moment of inertia about forward")[0]
    assert "○ not identifiable" in mass
    assert "scale together" in mass
    moment = text.partition("drag torque per thrust")[2].partition("drag in the rotor plane")[0]
    assert "● well known" in moment


def test_the_rolling_moment_is_not_identifiable(report: Path) -> None:
    text = words(report)
    rolling = text.partition("moment in the rotor plane")[2].partition("axial airspeed")[0]
    assert "○ not identifiable" in rolling
    assert "the flights alone determine it only to" in rolling
    assert "rolling_moment_coefficient alone: it is not identifiable" in text


def test_a_folder_that_is_no_runs_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="result folder"):
        render(tmp_path)
    with pytest.raises(InputError, match="is no folder"):
        render(tmp_path / "none")


def test_a_damaged_file_is_named(report: Path, tmp_path: Path) -> None:
    for name in ("result.json", "best_fit.yaml", "effective.yaml"):
        (tmp_path / name).write_bytes((report.parent / name).read_bytes())
    (tmp_path / "sensitivity.json").write_text('{"schema_version": 2}')
    with pytest.raises(InputError, match=r"sensitivity\.json"):
        render(tmp_path)


def test_a_term_that_makes_left_out_flights_worse_is_drawn_left_of_zero(report: Path) -> None:
    contents = read_contents(report.parent)
    assert contents.run is not None
    section = selection(contents)
    assert section is not None
    (panel,) = section.charts[0].panels
    gains = {row.group: row.gain_holdout for row in contents.run.result.selection}
    assert min(gains.values()) < 0.0
    drawn = {
        label: value
        for bars in panel.marks
        for label, value in zip(bars.labels, bars.values, strict=True)
        if value is not None
    }
    assert drawn == {name: pytest.approx(100.0 * gain) for name, gain in gains.items()}
    assert panel.x_scale == "linear"

"""The report as its readers see it: what it says, and that it draws in a browser."""

from __future__ import annotations

import html
import re
import time
from pathlib import Path

import pytest

from tests.tuner.report import making
from tests.tuner.report.browser import browser, find_chromium
from tuner.errors import InputError
from tuner.report import render

FREE = (
    "inertia_xx",
    "input_scaling",
    "motor_constant",
    "moment_constant",
    "rotor_drag_coefficient",
    "rolling_moment_coefficient",
    "estimate_latency",
)
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

needs_chromium = pytest.mark.skipif(
    find_chromium() is None, reason="needs Chromium or Chrome on the path"
)


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    making.write_run(folder, FREE, without=("rotor_speed", "body_rate"))
    return render(folder)


def words(page: Path) -> str:
    """Return what a reader reads, tags and scripts left out."""
    text = page.read_text().partition("<noscript>")[0]
    text = re.sub(r"<style>.*?</style>", " ", text, flags=re.DOTALL)
    return " ".join(html.unescape(re.sub(r"<[^>]*>", " ", text)).split())


def test_the_page_answers_what_a_reader_asks(report: Path) -> None:
    text = words(report)
    assert "on the held-out flights the position RMSE went from" in text
    assert "7 coefficients were fitted to 1 flight, of which the flights do not identify 1" in text
    for heading in (
        "Coefficients",
        "How closely the flights are met",
        "Simulated against recorded",
        "What each coefficient does",
        "Where the knowledge comes from",
        "What is left over",
        "How it was found",
        "How it was made",
    ):
        assert heading in text
    assert "swing, lap 2" in text
    assert "well known" in text
    assert "ab" * 32 in text
    assert "multirotor-tune 0.1.0" in text


def test_the_page_is_one_file_without_the_network(report: Path) -> None:
    raw = report.read_text()
    assert report.stat().st_size < 5_000_000
    head = raw.partition('<script id="figures"')[0]
    assert not re.search(r'(src|href)="(?!#|data:)', head)
    assert "@import" not in head
    assert "url(" not in head


def test_what_a_user_typed_stays_text(report: Path) -> None:
    assert making.COMMAND in words(report)
    assert making.COMMAND not in report.read_text()


def test_the_main_figures_are_written_for_papers(report: Path) -> None:
    names = {path.name for path in (report.parent / "plots").iterdir()}
    assert {"swing_position.svg", "correlation.svg", "sensitivity.svg", "waterfall.svg"} <= names
    first = (report.parent / "plots" / "correlation.svg").read_bytes()
    assert b"inertia_xx" in first
    render(report.parent)
    assert (report.parent / "plots" / "correlation.svg").read_bytes() == first


def test_the_same_folder_renders_the_same_page(report: Path) -> None:
    before = report.read_bytes()
    assert render(report.parent, plots=False).read_bytes() == before


@pytest.mark.slow
def test_a_freed_mass_is_named_as_the_scale_that_no_flight_shows(tmp_path: Path) -> None:
    making.write_run(tmp_path, WITH_MASS)
    text = words(render(tmp_path, plots=False))
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
    for name in ("result.json", "best_fit.yaml"):
        (tmp_path / name).write_bytes((report.parent / name).read_bytes())
    (tmp_path / "sensitivity.json").write_text('{"schema_version": 2}')
    with pytest.raises(InputError, match=r"sensitivity\.json"):
        render(tmp_path)


@needs_chromium
@pytest.mark.parametrize(
    ("width", "height", "dark"), [(1280, 900, False), (390, 844, True)], ids=["desktop", "phone"]
)
def test_every_figure_draws_in_a_browser(
    report: Path, tmp_path: Path, width: int, height: int, dark: bool
) -> None:
    with browser(tmp_path / "profile") as page:
        page.open(report, width=width, height=height, dark=dark)
        assert page.complaints == []
        count = page.evaluate("document.querySelectorAll('figure').length")
        assert count == 8 + 1 + 1 + 2 + 3 + 1 + 2
        # a figure is drawn if plotly has put marks into its axes
        drawn = "[...document.querySelectorAll('figure')].filter(f => f.querySelector({marks}))"
        marks = "'.scatterlayer .trace path, .barlayer .point path, .heatmaplayer image'"
        assert page.evaluate(f"{drawn.format(marks=marks)}.length") == count
        # nothing is cut off: the page is no wider than the window
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        ink = page.evaluate("getComputedStyle(document.querySelector('.gtitle, .xtitle')).fill")
        assert ink == ("rgb(230, 230, 230)" if dark else "rgb(29, 31, 33)")


@needs_chromium
def test_the_text_can_be_read_within_a_second(report: Path, tmp_path: Path) -> None:
    with browser(tmp_path / "profile") as page:
        page.open(report, width=1280, height=900)
        entry = "performance.getEntriesByType('navigation')[0].domContentLoadedEventEnd"
        assert page.evaluate(entry) < 5000.0  # ms; a fifth of it on an idle machine


@needs_chromium
def test_a_fault_of_the_page_would_be_seen(report: Path, tmp_path: Path) -> None:
    broken = tmp_path / "broken.html"
    broken.write_text(report.read_text().replace("Plotly.newPlot", "Plotly.nothing"))
    began = time.monotonic()
    with browser(tmp_path / "profile") as page:
        page.open(broken, width=1280, height=900)
        assert "Plotly.nothing is not a function" in page.complaints[0]
    assert time.monotonic() - began < 50.0

"""The report in a browser: on a desktop, on a phone, on paper, and where no script runs."""

from __future__ import annotations

import re
import zlib
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("playwright", reason="needs the extra 'test' (Playwright)")

from playwright.sync_api import Browser

from tests.tuner.report.browser import CHROMIUM, Reading, chromium, reading

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium or Chrome on the path")

FIGURES = 8 + 2 + 1 + 1 + 1 + 2 + 3 + 1 + 2
#: What the plotting library has put into its axes.
MARKS = ".scatterlayer .trace path, .barlayer .point path, .heatmaplayer image"
IMAGES = (
    "figures => figures.map(figure => figure.querySelector('.static')).filter("
    "i => i.complete && i.naturalWidth > 0 && i.clientWidth > 300 && i.clientHeight > 100).length"
)
POINTS = 300 * 3
"""Points of the three curves of a flight that the figures show."""
TITLE_COLOUR = "getComputedStyle(document.querySelector('.gtitle, .xtitle')).fill"
WIDTH = "document.documentElement.scrollWidth"
LIGHT, DARK = "rgb(29, 31, 33)", "rgb(230, 230, 230)"


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as started:
        yield started


@pytest.fixture(scope="module")
def desktop(browser: Browser, report: Path) -> Iterator[Reading]:
    with reading(browser, report) as opened:
        opened.wait_until_drawn()
        yield opened


def check_that_every_figure_is_drawn(opened: Reading, width: int, ink: str) -> None:
    page = opened.page
    assert opened.complaints == []
    assert page.locator("figure").count() == FIGURES
    assert page.locator("figure", has=page.locator(MARKS)).count() == FIGURES
    assert page.locator(".plot:visible > .plot-container").count() == FIGURES
    assert page.locator(".static:visible").count() == 0
    assert page.evaluate(WIDTH) <= width  # nothing is cut off
    assert page.evaluate(TITLE_COLOUR) == ink


def test_every_figure_draws_on_a_desktop(desktop: Reading) -> None:
    check_that_every_figure_is_drawn(desktop, 1280, LIGHT)


def test_every_figure_draws_on_a_phone_in_the_dark(browser: Browser, report: Path) -> None:
    with reading(browser, report, width=390, dark=True) as phone:
        phone.wait_until_drawn()
        check_that_every_figure_is_drawn(phone, 390, DARK)


def test_the_page_asks_the_network_for_nothing(desktop: Reading) -> None:
    assert {address.partition(":")[0] for address in desktop.requests} <= {"file", "data"}


def test_the_colours_of_the_figures_follow_the_scheme(desktop: Reading) -> None:
    for scheme, ink in (("dark", DARK), ("light", LIGHT)):
        desktop.page.emulate_media(color_scheme=scheme)
        desktop.page.locator(f".xtitle[style*='{ink}']").first.wait_for()


@pytest.mark.parametrize("width", [1280, 390], ids=["desktop", "phone"])
def test_without_scripts_every_figure_is_an_image(
    browser: Browser, report: Path, width: int
) -> None:
    with reading(browser, report, width=width, scripts=False) as opened:
        assert opened.complaints == []
        assert opened.page.locator("figure").evaluate_all(IMAGES) == FIGURES
        assert opened.page.evaluate("document.documentElement.scrollWidth") <= width


def test_what_is_printed_at_once_has_every_figure(browser: Browser, report: Path) -> None:
    with reading(browser, report, dark=True) as opened:
        check_that_every_figure_is_printed(opened)


def test_what_is_printed_later_has_every_figure(desktop: Reading) -> None:
    check_that_every_figure_is_printed(desktop)


def check_that_every_figure_is_printed(opened: Reading) -> None:
    page = opened.page
    page.emulate_media(media="print")
    assert page.locator("figure").evaluate_all(IMAGES) == FIGURES
    assert page.locator(".plot:visible").count() == 0
    with_figures = lines_of(page.pdf())
    page.evaluate("document.querySelector('main').hidden = true")
    assert with_figures - lines_of(page.pdf()) > 2 * POINTS
    page.evaluate("document.querySelector('main').hidden = false")
    page.emulate_media(media="screen")
    assert opened.complaints == []


def lines_of(pdf: bytes) -> int:
    """Return how many straight lines a PDF file draws."""
    streams = re.findall(rb"stream\r?\n(.*?)endstream", pdf, flags=re.DOTALL)
    unpacked = (zlib.decompressobj().decompress(part) for part in streams if part[:1] == b"\x78")
    return sum(len(re.findall(rb" l\n", part)) for part in unpacked)


def test_nothing_is_wider_than_a_sheet_of_paper(browser: Browser, report: Path) -> None:
    sheet = round(180 / 25.4 * 96)  # A4 without its margins; Letter is wider
    with reading(browser, report, width=sheet, scripts=False) as opened:
        opened.page.emulate_media(media="print")
        assert opened.page.evaluate(WIDTH) <= sheet


def test_the_keyboard_reaches_what_can_be_operated(desktop: Reading) -> None:
    reached = set()
    for _ in range(desktop.page.locator("a, summary").count() + 20):
        desktop.page.keyboard.press("Tab")
        reached.add(desktop.page.evaluate("document.activeElement.localName"))
    assert {"a", "summary", "button"} <= reached


def test_a_figure_can_be_saved(desktop: Reading) -> None:
    with desktop.page.expect_download() as download:
        desktop.page.locator("[data-title*=Download]").first.click()
    assert download.value.path().read_bytes().startswith(b"\x89PNG")
    assert desktop.complaints == []


def test_a_page_saved_from_the_browser_draws_again(
    browser: Browser, desktop: Reading, tmp_path: Path
) -> None:
    saved = tmp_path / "saved.html"
    saved.write_text(desktop.page.content())
    with reading(browser, saved) as opened:
        opened.wait_until_drawn()
        check_that_every_figure_is_drawn(opened, 1280, LIGHT)


def test_only_the_pages_own_scripts_run(browser: Browser, report: Path, tmp_path: Path) -> None:
    changed = tmp_path / "changed.html"
    changed.write_text(report.read_text().replace("</main>", "</main><script>alert(1)</script>"))
    with reading(browser, changed, before="window.alert = () => { throw 'ran'; }") as opened:
        assert len(opened.complaints) == 1
        assert "Content Security Policy" in opened.complaints[0]


def test_where_the_script_fails_the_images_stay(browser: Browser, report: Path) -> None:
    fails = "Object.defineProperty(window, 'Plotly', { value: {}, writable: false });"
    with reading(browser, report, before=fails) as opened:
        opened.page.wait_for_event("pageerror", lambda error: "newPlot" in str(error))
        assert opened.page.locator("figure").evaluate_all(IMAGES) == FIGURES


def test_the_text_can_be_read_within_a_second(desktop: Reading) -> None:
    entry = "performance.getEntriesByType('navigation')[0].domContentLoadedEventEnd"
    assert desktop.page.evaluate(entry) < 5000.0  # ms; a fifth of it on an idle machine

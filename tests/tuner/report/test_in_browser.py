"""The report in a browser: on a desktop, on a phone, on paper, and where no script runs."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import pytest

pytest.importorskip("playwright", reason="needs the extra 'test' (Playwright)")

from playwright.sync_api import Browser

from tests.tuner.evaluate.test_compare import GOOD
from tests.tuner.report.browser import CHROMIUM, PATIENCE, Reading, chromium, reading
from tuner.evaluate.comparison import table_of
from tuner.report.comparison import write_table

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium or Chrome on the path")

FIGURES = 8 + 2 + 1 + 1 + 2 + 3 + 1 + 2
#: What the plotting library has put into its axes.
MARKS = ":is([aria-label=line], [aria-label=dot], [aria-label=bar], [aria-label=cell]) > *"
OPEN = "document.querySelectorAll('details').forEach((place) => { place.open = true; })"
TITLE_COLOUR = "getComputedStyle(document.querySelector('[aria-label=\"x-axis label\"]')).fill"
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


def draw_everything(opened: Reading) -> None:
    """Open all that is folded and look at each figure, which is drawn then."""
    opened.page.evaluate(OPEN)
    for figure in opened.page.locator("figure").all():
        figure.scroll_into_view_if_needed()
        figure.locator(MARKS).first.wait_for(state="attached", timeout=PATIENCE)
    opened.page.wait_for_function(f"document.querySelectorAll('[data-drawn]').length == {FIGURES}")


def check_that_every_figure_is_drawn(opened: Reading, width: int, ink: str) -> None:
    page = opened.page
    draw_everything(opened)
    assert opened.complaints == []
    assert page.locator("figure").count() == FIGURES
    assert page.locator("figure", has=page.locator(MARKS)).count() == FIGURES
    assert page.evaluate(WIDTH) <= width  # nothing is cut off
    assert page.evaluate(TITLE_COLOUR) == ink


def test_the_first_screen_says_whether_the_fit_can_be_used(browser: Browser, report: Path) -> None:
    for width in (1280, 390):
        with reading(browser, report, width=width) as opened:
            for shown in (".standing", ".outcome li >> nth=0", "nav a >> nth=0"):
                box = opened.page.locator(shown).first.bounding_box()
                assert box is not None
                assert box["y"] + box["height"] < 900
            assert opened.page.evaluate("document.documentElement.scrollHeight") < 9 * 900


def test_a_comparison_on_a_phone_scrolls_within_its_table(browser: Browser, tmp_path: Path) -> None:
    names = ("a_vehicle_with_a_long_name", "another_one")
    write_table(table_of({name: {"circle_3mps": GOOD} for name in names}), tmp_path / "c.html")
    with reading(browser, tmp_path / "c.html", width=390) as opened:
        assert opened.page.evaluate(WIDTH) <= 390


def test_every_figure_draws_on_a_desktop(desktop: Reading) -> None:
    check_that_every_figure_is_drawn(desktop, 1280, LIGHT)


def test_every_figure_draws_on_a_phone_in_the_dark(browser: Browser, report: Path) -> None:
    with reading(browser, report, width=390, dark=True) as phone:
        phone.wait_until_drawn()
        check_that_every_figure_is_drawn(phone, 390, DARK)


def test_what_is_folded_is_not_drawn(browser: Browser, report: Path) -> None:
    with reading(browser, report) as opened:
        opened.wait_until_drawn()
        assert opened.page.locator("details [data-drawn]").count() == 0


def test_the_contents_stay_and_open_what_is_folded(browser: Browser, report: Path) -> None:
    with reading(browser, report) as opened:
        opened.wait_until_drawn()
        assert opened.page.locator("#provenance[open]").count() == 0
        opened.page.locator("nav a", has_text="Provenance").click()
        opened.page.locator("#provenance[open]").wait_for()
        assert opened.page.locator("nav").evaluate("n => n.getBoundingClientRect().top") >= 0


def test_the_page_asks_the_network_for_nothing(desktop: Reading) -> None:
    assert {address.partition(":")[0] for address in desktop.requests} <= {"file", "data"}


def test_the_colours_of_the_figures_follow_the_scheme(desktop: Reading) -> None:
    for scheme, ink in (("dark", DARK), ("light", LIGHT)):
        desktop.page.emulate_media(color_scheme=scheme)
        desktop.page.wait_for_function(f"{TITLE_COLOUR} == '{ink}'")


@pytest.mark.parametrize("width", [1280, 390], ids=["desktop", "phone"])
def test_without_scripts_the_words_and_tables_are_there(
    browser: Browser, report: Path, width: int
) -> None:
    with reading(browser, report, width=width, scripts=False) as opened:
        assert opened.complaints == []
        assert opened.page.locator("figure:visible").count() == 0
        assert opened.page.locator("noscript").inner_text().startswith("Figures need a script")
        assert opened.page.evaluate("document.documentElement.scrollWidth") <= width


def test_a_summary_of_one_sheet_is_printed(desktop: Reading) -> None:
    pdf = desktop.page.pdf(prefer_css_page_size=True)
    assert [int(count) for count in re.findall(rb"/Count (\d+)", pdf)] == [1]
    desktop.page.emulate_media(media="print")
    assert desktop.page.locator("#coefficients td.name:visible").count() > 5
    assert desktop.page.locator("figure:visible, details:visible").count() == 0
    desktop.page.emulate_media(media="screen")


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


def test_charts_of_one_flight_share_their_time(desktop: Reading) -> None:
    draw_everything(desktop)
    desktop.page.locator("[data-chart=swing_position]").scroll_into_view_if_needed()
    panel = desktop.page.locator("[data-chart=swing_position] .plot > svg .overlay").first
    box = panel.bounding_box()
    assert box is not None
    desktop.page.mouse.move(box["x"] + 0.2 * box["width"], box["y"] + 20)
    desktop.page.mouse.down()
    desktop.page.mouse.move(box["x"] + 0.4 * box["width"], box["y"] + 20, steps=4)
    desktop.page.mouse.up()
    assert seconds(desktop, "swing_position")[-1] < 3.0
    assert seconds(desktop, "swing_attitude") == seconds(desktop, "swing_position")
    assert seconds(desktop, "swing_error") == seconds(desktop, "swing_position")
    assert seconds(desktop, "spin_error")[-1] > 5.0
    desktop.page.locator("[data-chart=swing_error] .overlay").first.dblclick()
    assert seconds(desktop, "swing_position") == seconds(desktop, "spin_error")


def seconds(opened: Reading, chart: str) -> list[float]:
    """Return what a figure's time axis is labelled with."""
    ticks = opened.page.locator(f"[data-chart={chart}] [aria-label='x-axis tick label'] text")
    return [float(text) for text in ticks.all_text_contents()]


def test_a_name_in_the_legend_hides_its_curve(desktop: Reading) -> None:
    draw_everything(desktop)
    curves = desktop.page.locator("[data-chart=swing_error] [aria-label=line] path")
    name = desktop.page.locator("[data-chart=swing_error] .legend button", has_text="initial")
    assert curves.count() == 4
    name.click()
    assert curves.count() == 2
    name.click()
    assert curves.count() == 4


def test_a_figure_can_be_saved(desktop: Reading) -> None:
    with desktop.page.expect_download() as download:
        desktop.page.locator(".save").first.click()
    saved = ElementTree.parse(download.value.path()).getroot()
    assert saved.tag.endswith("svg")
    assert len(list(saved.iter())) > 50
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


def test_the_text_can_be_read_within_a_second(desktop: Reading) -> None:
    entry = "performance.getEntriesByType('navigation')[0].domContentLoadedEventEnd"
    assert desktop.page.evaluate(entry) < 5000.0  # ms; a fifth of it on an idle machine

"""The pages in a browser: from dropped recordings to a report, on a desktop and on a phone."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

pytest.importorskip("playwright", reason="needs the extra 'test' (Playwright)")

from playwright.sync_api import Browser, Page

from tests.tuner.report.browser import CHROMIUM, PATIENCE, chromium
from tests.tuner.service.conftest import FLIGHTS, ended, submit, upload

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium or Chrome on the path")

PAPER = "getComputedStyle(document.body).backgroundColor"
WIDTH = "document.documentElement.scrollWidth"
BAGS = [FLIGHTS / "yaw_spin_3rps.bag", FLIGHTS / "diagonal_3mps.bag"]


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as started:
        yield started


@contextmanager
def visiting(
    browser: Browser,
    client,
    *,
    width: int = 1280,
    dark: bool = False,
    scripts: bool = True,
    complaints: list[str] | None = None,
) -> Iterator[Page]:
    """Open a window that only reaches the server, and hold that nothing was complained of."""
    context = browser.new_context(
        base_url=str(client.base_url),
        viewport={"width": width, "height": 900},
        is_mobile=width < 600,
        color_scheme="dark" if dark else "light",
        java_script_enabled=scripts,
    )
    expected = complaints is not None
    complaints = [] if complaints is None else complaints
    elsewhere: list[str] = []
    try:
        page = context.new_page()
        page.set_default_timeout(PATIENCE)
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("console", lambda message: complaints.append(message.text))
        page.on("request", lambda request: elsewhere.append(request.url))
        yield page
        assert complaints == [] or expected
        assert [url for url in elsewhere if not url.startswith(str(client.base_url))] == []
    finally:
        context.close()


def from_bags_to_the_report(page: Page, width: int) -> None:
    page.goto("/")
    assert not page.get_by_role("button", name="Start the fit").is_visible()
    page.set_input_files("#file", BAGS)
    page.locator("[data-recording]").nth(1).wait_for()
    assert page.get_by_text("a yaw spin at 3.0 rad/s").is_visible()
    assert page.evaluate(WIDTH) <= width
    page.locator("[data-recording]").nth(1).get_by_label("to check the fit").check()
    page.get_by_label("Name of the job").fill("First <b>fit</b>")
    page.get_by_role("button", name="Start the fit").click()
    page.get_by_role("link", name="Open the report").wait_for()
    assert page.get_by_role("heading", name="First <b>fit</b>").is_visible()
    page.locator("[data-chart=rmse] [aria-label=line] path").wait_for(state="attached")
    assert "diagonal_3mps.bag (checks the fit)" in page.inner_text("main")
    assert page.evaluate(WIDTH) <= width
    page.locator("iframe").scroll_into_view_if_needed()
    assert page.frame_locator("iframe").get_by_text("fitted").inner_text() == "fitted"
    page.get_by_role("link", name="Open the report").click()
    assert page.inner_text("body") == "fitted"


@pytest.mark.usefixtures("real_inspection")
def test_a_newcomer_gets_from_the_bags_to_the_report(browser, client):
    with visiting(browser, client) as page:
        from_bags_to_the_report(page, 1280)


@pytest.mark.usefixtures("real_inspection")
def test_it_works_on_a_phone_in_the_dark(browser, client):
    with visiting(browser, client, width=390, dark=True) as page:
        from_bags_to_the_report(page, 390)
        for path in ("/", "/jobs", "/vehicles/hovergames"):
            page.goto(path)
            assert page.evaluate(WIDTH) <= 390
            assert page.evaluate(PAPER) == "rgb(22, 24, 26)"


def test_the_curve_and_the_list_move_by_themselves(browser, client, table):
    recording = upload(client, table.read_bytes())
    job = submit(client, recording, namespace="slow")
    with visiting(browser, client) as page:
        page.goto(f"/jobs/{job}")
        curve = page.locator("[data-chart=rmse] [aria-label=line] path")
        curve.wait_for(state="attached")
        first = curve.get_attribute("d")
        other = page.locator(f'[data-chart=rmse] [aria-label=line] path:not([d="{first}"])')
        other.wait_for(state="attached")
        page.get_by_role("link", name="Open the report").wait_for()  # the page turned by itself
        page.goto("/jobs")
        other = submit(client, recording, name="another one")
        page.get_by_role("link", name="another one").wait_for()
        ended(client, other)


def test_all_of_it_can_be_done_from_the_keyboard_without_a_script(browser, client, table):
    recording = upload(client, table.read_bytes())
    complaints: list[str] = []
    with visiting(browser, client, scripts=False, complaints=complaints) as page:
        page.goto(f"/?r={recording}")
        page.keyboard.press("Tab")
        assert page.locator(":focus").inner_text() == "Skip to the content"
        page.get_by_label("Weighed mass, kg").focus()
        page.keyboard.type("heavy")
        page.keyboard.press("Enter")
        assert (
            page.get_by_role("alert").inner_text()
            == "mass: 'heavy' is no number; give kg, as 2.243"
        )
        assert page.get_by_label("Weighed mass, kg").input_value() == "heavy"
        page.get_by_label("Weighed mass, kg").fill("2,243")
        page.keyboard.press("Enter")
        page.wait_for_url("**/jobs/*")
        job = page.url.rpartition("/")[2]
        ended(client, job)
        page.reload()
        page.get_by_role("link", name="Open the report").wait_for()
    assert ["status of 422" in line for line in complaints] == [True]  # the browser's own line


def test_what_a_dropped_tune_yaml_holds_out_is_marked_before_the_job_starts(
    browser, client, table, tmp_path
):
    before = tmp_path / "before.csv"
    before.write_bytes(table.read_bytes() + b"3,1,0,1,1,0,0,0\n")
    settings = tmp_path / "tune.yaml"
    settings.write_text("holdout: [hop, before]\n")
    complaints: list[str] = []
    with visiting(browser, client, complaints=complaints) as page:
        page.goto("/")
        page.set_input_files("#file", before)
        page.locator("[data-flight=before]").wait_for()
        page.set_input_files("#file", settings)
        page.get_by_role("button", name="Start the fit").click()
        page.get_by_text("settings: hold out hop, before; see what checks the fit below").wait_for()
        assert page.locator("[data-flight=before]").get_by_label("to check the fit").is_checked()
        page.set_input_files("#file", table)  # a recording that comes later is marked, too
        page.locator("[data-flight=hop]").wait_for()
        assert page.locator("[data-flight=hop]").get_by_label("to check the fit").is_checked()
    assert ["status of 422" in line for line in complaints] == [True]  # the browser's own line


def test_an_upload_that_is_refused_or_cancelled_says_so(browser, client, tmp_path):
    wrong = tmp_path / "empty.bag"
    wrong.write_bytes(b"")
    with visiting(browser, client) as page:
        page.goto("/")
        page.route("**/recordings", lambda _: None)  # never answered
        page.set_input_files("#file", BAGS[0])
        page.get_by_role("button", name="Cancel").click()
        assert page.get_by_text("the upload was cancelled; nothing of it is kept").is_visible()
        page.unroute("**/recordings")
    complaints: list[str] = []
    with visiting(browser, client, complaints=complaints) as page:
        page.goto("/")
        page.set_input_files("#file", wrong)
        page.get_by_role("alert").wait_for()
        assert "empty.bag: is empty; check the recording" in page.inner_text("#uploads")
    assert ["status of 422" in line for line in complaints] == [True]  # the browser's own line


def test_a_vehicle_s_history_and_a_comparison_are_drawn(browser, client, table):
    recording = upload(client, table.read_bytes())
    jobs = [ended(client, submit(client, recording, name=f"day {n}"))["id"] for n in range(3)]
    with visiting(browser, client) as page:
        page.goto("/vehicles/hovergames")
        chart = page.locator("[data-chart=motor_constant]")
        chart.locator("[aria-label=dot] circle").nth(2).wait_for()
        interval = chart.locator("[aria-label=line] path").get_attribute("d")
        assert interval is not None
        assert interval.count("M") == 3
        labels = chart.locator("[aria-label='y-axis tick label']").all_text_contents()
        assert "1e-7" in labels[0]
        page.get_by_text("Numbers, and the flights behind them").click()
        assert page.get_by_role("cell", name="hop").count() == 3
        page.goto(f"/jobs/{jobs[2]}")
        page.get_by_label("with").select_option(jobs[0])
        page.get_by_role("button", name="Compare").click()
        row = page.get_by_role("row", name="motor_constant")
        assert "+0.00 %" in row.inner_text()
        assert page.get_by_role("heading", name="Flights of both").is_visible()

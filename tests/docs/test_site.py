"""The documentation as a site: it builds without a warning and is readable on a phone."""

from __future__ import annotations

import shutil
import time
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import pytest

from tests.docs.checkout import make_checkout, typed
from tests.docs.pages import DOCS

pytestmark = pytest.mark.skipif(find_spec("mkdocs") is None, reason="needs the extra 'docs'")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = make_checkout(tmp_path_factory.mktemp("site"))
    (place / "docs").unlink()
    shutil.copytree(DOCS, place / "docs", ignore=shutil.ignore_patterns("__pycache__"))
    typed("make docs", place)
    return place / "build" / "site"


def test_every_page_is_built(site: Path):
    for page in DOCS.rglob("*.md"):
        assert (site / page.relative_to(DOCS).with_suffix(".html")).exists(), page


def test_the_python_reference_has_its_signatures(site: Path):
    page = (site / "reference" / "python.html").read_text(encoding="utf-8")
    for name in ("tuner.api.fit", "tuner.api.load_flight", "tuner.result.CoefficientResult"):
        assert f'id="{name}"' in page


@pytest.fixture(scope="module")
def reading():
    """Return what opens a page of the site in one browser for all."""
    browser = pytest.importorskip("tests.tuner.report.browser", reason="needs Playwright")
    if browser.CHROMIUM is None:
        pytest.skip("needs Chromium or Chrome on the path")
    with browser.chromium() as started:
        yield partial(browser.reading, started)


@pytest.mark.parametrize("width", [1280, 390], ids=["desktop", "phone"])
def test_a_browser_shows_it_whole(site: Path, reading, width: int):
    for name in ("index", "tutorials/first-fit", "explanations/model", "reference/messages"):
        with reading(site / f"{name}.html", width=width) as opened:
            page = opened.page
            assert page.locator("h1").first.is_visible(), name
            assert page.evaluate("document.documentElement.scrollWidth") <= width, name
            asked = {address.partition(":")[0] for address in opened.requests}
            assert asked <= {"file", "data", "blob"}, name
            broken = "[...document.images].filter(i => i.complete && !i.naturalWidth).length"
            assert page.evaluate(broken) == 0, name


def test_search_works_in_pages_that_are_opened_as_files(site: Path, reading):
    with reading(site / "tutorials/first-fit.html") as opened:
        page = opened.page
        field, links = page.locator(".md-search__input"), page.locator(".md-search-result__link")
        deadline = time.monotonic() + 60.0
        while not links.count():  # what is typed before the page's script has begun is not heard
            assert time.monotonic() < deadline
            field.fill("")
            field.press_sequentially("finer_than_steps")  # it hears keys, not a value set
            page.wait_for_timeout(1000)
        assert any("messages.html" in (link.get_attribute("href") or "") for link in links.all())
        asked = {address.partition(":")[0] for address in opened.requests}
        assert asked <= {"file", "data", "blob"}
        assert opened.complaints == []

"""The system's Chromium, headless and without a network: pages as a reader would see them."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from playwright.sync_api import Browser, Page, sync_playwright

CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "google-chrome", "chromium-browser"))), None
)
ARGUMENTS = (
    "--no-sandbox",
    "--disable-gpu",
    "--disable-dev-shm-usage",
    "--disable-quic",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
)
PATIENCE = 60_000.0
"""ms within which a page has drawn its figures on a busy machine."""


@dataclass(frozen=True)
class Reading:
    """A page that is open, with its errors and warnings and what it asked the network for."""

    page: Page
    complaints: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)

    def wait_until_drawn(self) -> None:
        self.page.wait_for_selector("body[data-ready]", timeout=PATIENCE)


@contextmanager
def chromium() -> Iterator[Browser]:
    """Start a browser that ends with the block."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        try:
            yield browser
        finally:
            browser.close()


@contextmanager
def reading(
    browser: Browser,
    file: Path,
    *,
    width: int = 1280,
    dark: bool = False,
    scripts: bool = True,
    before: str = "",
) -> Iterator[Reading]:
    """Open a file in a window of its own, a script run ``before`` those of the page."""
    context = browser.new_context(
        viewport={"width": width, "height": 900},
        is_mobile=width < 600,
        color_scheme="dark" if dark else "light",
        java_script_enabled=scripts,
        offline=True,
    )
    try:
        page = context.new_page()
        opened = Reading(page)
        page.add_init_script(before)
        page.on("pageerror", lambda error: opened.complaints.append(str(error)))
        page.on("console", lambda message: opened.complaints.append(message.text))
        page.on("request", lambda request: opened.requests.append(request.url))
        page.goto(file.resolve().as_uri())
        yield opened
    finally:
        context.close()

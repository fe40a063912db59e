"""A browser for several pages, and waiting for what the viewer page does."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator

from browser_page import CHROMIUM, FLAGS
from playwright.sync_api import Browser, Page, sync_playwright

WAIT_LIMIT_S = 30.0


@contextlib.contextmanager
def chromium() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, headless=True, args=FLAGS)
        try:
            yield browser
        finally:
            browser.close()


def wait_until(page: Page, expression: str, limit_s: float = WAIT_LIMIT_S) -> None:
    """Wait for a JavaScript expression to be true. Playwright's own wait needs eval, which the page's CSP forbids."""
    limit = time.monotonic() + limit_s
    while not page.evaluate(expression):
        said = page.inner_text(".status")
        assert time.monotonic() < limit, f"{expression} did not become true in {limit_s:g} s, the page says {said!r}"
        page.wait_for_timeout(50)


def wait_playing(page: Page) -> None:
    """Wait for pictures that come now, not for one that once came."""
    before = page.evaluate("mr360.viewer.frames.count")
    wait_until(page, f"mr360.viewer.panorama.size[0] > 0 && mr360.viewer.frames.count > {before} + 3")

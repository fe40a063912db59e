"""The pages of a service that wants a token."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Page
from running_service import Service
from viewer_page import wait_playing, wait_until

pytestmark = pytest.mark.e2e

VIEWER, CREW = "viewer-token-0123456789", "crew-token-012345678901"


@pytest.fixture(scope="module")
def guarded(known_source: Path) -> Iterator[Service]:
    config = known_source.parent / "guarded.toml"
    config.write_text(f'tokens = [{{ token = "{VIEWER}", may = ["view"] }}, {{ token = "{CREW}", may = ["view", "control"] }}]\n')
    running = Service(known_source.parent, "--source", str(known_source), "--config", str(config))
    running.http.headers["Authorization"] = f"Bearer {CREW}"
    try:
        running.wait_ready()
        yield running
    finally:
        running.stop()
        assert VIEWER not in running.process.output()


def test_the_viewer_page_takes_its_token_from_the_address_and_hides_it(page: Page, guarded: Service) -> None:
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    page.goto(f"{guarded.url}/view/live#token={VIEWER}&yaw=30")
    wait_playing(page)
    wait_until(page, "document.getElementById('status-title').textContent === 'Live'")
    assert "token" not in page.evaluate("location.href")
    assert page.evaluate("Math.round(mr360.viewer.look.yaw * 180 / Math.PI)") == 30
    page.reload()
    wait_playing(page)
    assert not [url for url in asked if VIEWER in url]


def test_without_a_token_the_page_says_so(page: Page, guarded: Service) -> None:
    page.goto(f"{guarded.url}/view/live")
    wait_until(page, "document.getElementById('status-title').textContent === 'Not allowed'")
    assert "no token is given" in page.inner_text("#status-detail").lower()
    page.goto(f"{guarded.url}/view/live#token=wrong")
    page.reload()
    wait_until(page, "document.getElementById('status-detail').textContent.includes('The token is unknown')")


def test_the_control_page_works_with_a_token_that_may_control(page: Page, guarded: Service) -> None:
    page.goto(f"{guarded.url}/control/live#token={CREW}")
    wait_until(page, "!document.getElementById('add-button').disabled")
    page.click("#add-button")
    wait_until(page, "document.querySelectorAll('#objects .object').length === 1")
    wait_until(page, "document.getElementById('lights').rows.length > 0")
    assert len(guarded.request("GET", "/api/streams/live/objects")) == 1


def test_the_list_of_streams_leads_on_with_the_token(page: Page, guarded: Service) -> None:
    page.goto(f"{guarded.url}/#token={VIEWER}")
    page.click("#streams a:has-text('live')")
    page.wait_for_url(f"{guarded.url}/view/live")
    wait_playing(page)


def test_who_may_only_view_is_told_so_on_the_control_page(page: Page, guarded: Service) -> None:
    page.goto(f"{guarded.url}/control/live#token={VIEWER}")
    wait_until(page, "!document.getElementById('add-button').disabled")
    page.click("#add-button")
    wait_until(page, "document.getElementById('add-complaint').textContent.includes('may not control')")

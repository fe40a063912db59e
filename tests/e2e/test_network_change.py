"""A viewer whose network changes under it: Chromium in a network namespace that loses its address and gets another one."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from browser_page import CHROMIUM, FLAGS
from playwright.sync_api import Page, sync_playwright
from running_service import Service
from viewer_page import wait_playing, wait_until

pytestmark = [pytest.mark.e2e, pytest.mark.alone,
              pytest.mark.skipif(os.geteuid() != 0 or shutil.which("ip") is None,
                                 reason="network namespaces need root and iproute2")]

NETWORK = "10.213.7"
SPACE = f"mr360-{os.getpid()}"
CABLE = f"mr{os.getpid()}"


def ip(*words: str, check: bool = True) -> None:
    subprocess.run(["ip", *words], check=check, capture_output=not check)


def move_to(address: str, old: str | None = None) -> None:
    """The viewer's machine has this address now, and no other."""
    if old is not None:
        ip("-n", SPACE, "address", "del", f"{old}/24", "dev", "viewer")
    ip("-n", SPACE, "address", "add", f"{address}/24", "dev", "viewer")
    ip("-n", SPACE, "route", "replace", "default", "via", f"{NETWORK}.1")


@pytest.fixture(scope="module")
def space() -> Iterator[str]:
    """A namespace with one cable to this one."""
    try:
        ip("netns", "add", SPACE)
        ip("link", "add", CABLE, "type", "veth", "peer", "name", "viewer", "netns", SPACE)
        ip("address", "add", f"{NETWORK}.1/24", "dev", CABLE)
        ip("link", "set", CABLE, "up")
        ip("-n", SPACE, "link", "set", "lo", "up")
        ip("-n", SPACE, "link", "set", "viewer", "up")
        move_to(f"{NETWORK}.2")
    except subprocess.CalledProcessError as error:
        pytest.skip(f"no network namespaces here: {error}")
    try:
        yield SPACE
    finally:
        ip("link", "del", CABLE, check=False)
        ip("netns", "del", SPACE, check=False)


@pytest.fixture
def distant_page(space: str, tmp_path: Path) -> Iterator[Page]:
    """A page of a browser in the namespace."""
    inside = tmp_path / "chromium"
    inside.write_text(f'#!/bin/sh\nexec ip netns exec {space} {CHROMIUM} "$@"\n')
    inside.chmod(0o755)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=inside, headless=True, args=FLAGS)
        try:
            yield browser.new_page(viewport={"width": 480, "height": 300})
        finally:
            browser.close()


@pytest.fixture
def wide_service(known_source: Path, space: str) -> Iterator[Service]:
    config = known_source.parent / "wide.toml"
    config.write_text(f'host = "0.0.0.0"\nice_networks = ["{NETWORK}.0/24"]\n')
    running = Service(known_source.parent, "--source", str(known_source), "--host", "0.0.0.0", "--config", str(config))
    try:
        running.wait_ready()
        yield running
    finally:
        running.stop()


def viewer_number(service: Service) -> int:
    one, = service.request("GET", "/api/streams/live/viewers")
    return int(one["viewer"])


def test_the_session_goes_on_at_another_address(distant_page: Page, wide_service: Service) -> None:
    page = distant_page
    page.goto(f"http://{NETWORK}.1:{wide_service.port}/view/live")
    wait_playing(page)
    number = viewer_number(wide_service)
    old = f"{NETWORK}.2"
    for new in (f"{NETWORK}.3", f"{NETWORK}.4"):
        frames = page.evaluate("mr360.viewer.frames.count")
        move_to(new, old)
        moved = time.monotonic()
        wait_until(page, f"mr360.viewer.frames.count > {frames} + 30", limit_s=25)
        print(f"picture again {time.monotonic() - moved:.1f} s after the move to {new}")
        wait_playing(page)
        assert viewer_number(wide_service) == number, "it is a new session"
        old = new


def test_a_cable_that_is_pulled_for_five_seconds(distant_page: Page, wide_service: Service) -> None:
    page = distant_page
    page.goto(f"http://{NETWORK}.1:{wide_service.port}/view/live")
    wait_playing(page)
    number = viewer_number(wide_service)
    with contextlib.ExitStack() as plugged:
        ip("link", "set", CABLE, "down")
        plugged.callback(ip, "link", "set", CABLE, "up")
        time.sleep(5)
    frames, back = page.evaluate("mr360.viewer.frames.count"), time.monotonic()
    wait_until(page, f"mr360.viewer.frames.count > {frames} + 5", limit_s=20)
    print(f"picture again {time.monotonic() - back:.1f} s after the cable is back")
    assert viewer_number(wide_service) == number, "it is a new session"

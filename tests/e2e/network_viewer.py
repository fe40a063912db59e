"""Chromium in a network of its own, playing a stream with the page's WHEP client, and what it noticed."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

from browser_page import CHROMIUM, FLAGS
from network_namespace import Network
from playwright.sync_api import Page, Playwright
from processes import wait_for

_PAGE = "web/whep.js"       # of the service's origin and network, with nothing in it that draws
_START = """
async (url) => {
  const { WhepClient } = await import('/web/whep.js');
  const video = document.body.appendChild(document.createElement('video'));
  Object.assign(video, { muted: true, autoplay: true, playsInline: true });
  Object.assign(video.style, { position: 'fixed', left: 0, top: 0, width: '64px', height: '32px' });
  window.frames_ = [];
  window.streams = 0;
  const onFrame = (now, { width }) => {
    video.requestVideoFrameCallback(onFrame);
    window.frames_.push([performance.timeOrigin + performance.now(), width]);
  };
  video.requestVideoFrameCallback(onFrame);
  window.client = new WhepClient(url);
  window.client.addEventListener('stream', ({ detail }) => { window.streams += 1; video.srcObject = detail; });
  window.client.start();
}
"""
_STATS = """
async () => {
  const reports = window.client.peer ? [...(await window.client.peer.getStats()).values()] : [];
  return reports.find(({ type, kind }) => type === 'inbound-rtp' && kind === 'video') ?? {};
}
"""


class NetworkViewer:
    """One page. Times are seconds of the system's clock."""

    def __init__(self, page: Page, base: str, query: str) -> None:
        self._page = page
        page.goto(f"{base}/{_PAGE}")
        page.evaluate(_START, f"{base}/whep/live{query}")

    @property
    def sessions(self) -> int:
        """How many times media has begun, in one session each."""
        return int(self._page.evaluate("window.streams"))

    @property
    def state(self) -> str:
        return str(self._page.evaluate("`${window.client.state} ${window.client.detail ?? ''}`"))

    def stats(self) -> dict[str, Any]:
        """`inbound-rtp` of the video in getStats."""
        found: dict[str, Any] = self._page.evaluate(_STATS)
        return found

    def frames(self) -> list[tuple[float, int]]:
        """When each frame so far was presented, and its width."""
        return [(time_ms / 1e3, width) for time_ms, width in self._page.evaluate("window.frames_")]

    def wait_playing(self, seconds: float = 30.0) -> None:
        """Until ten more frames have been presented."""
        before = len(self.frames())
        try:
            wait_for("picture", lambda: len(self.frames()) >= before + 10, seconds)
        except AssertionError as error:
            raise AssertionError(f"{error}: the client is {self.state}, {self.stats()}") from None

    def wait(self, seconds: float) -> None:
        self._page.wait_for_timeout(1e3 * seconds)

    def longest_pause_s(self, since: float, until: float) -> float:
        """Without a new picture, between these times."""
        times = [since, *(at for at, _ in self.frames() if since < at < until), until]
        return max(after - before for before, after in pairwise(times))


@contextlib.contextmanager
def network_viewer(playwright: Playwright, url: str, network: Network | None = None, query: str = "") -> Iterator[NetworkViewer]:
    """A fresh Chromium, in that network or in this machine's. `url` is the service's, as seen from there."""
    program = CHROMIUM if network is None else str(network.wrapper(CHROMIUM))
    browser = playwright.chromium.launch(executable_path=program, headless=True, args=FLAGS)
    try:
        yield NetworkViewer(browser.new_page(viewport={"width": 200, "height": 100}), url, query)
    finally:
        browser.close()

"""What Chromium shows of a stream, frame by frame: the time code's blocks and when each frame came, was decoded and was due."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from server.demo import time_code
from server.demo.watch import DemoError

if TYPE_CHECKING:
    from playwright.sync_api import Page

CHROMIUM = "/usr/bin/chromium"
FLAGS = ("--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-component-update",
         "--disable-sync", "--autoplay-policy=no-user-gesture-required", "--disable-features=WebRtcHideLocalIpsWithMdns",
         "--disable-gpu")       # a small picture of the video is drawn by the processor, which is cheaper than OpenGL on it
PAGE = "bench-latency"
CLOCK_READINGS = 40

_HTML = "<!doctype html><title>latency</title><video id=video muted autoplay playsinline style='width:64px;height:32px'></video>"

# The blocks' means come from the decoder's own luma: drawing a whole panorama into a canvas costs milliseconds a frame.
_SCRIPT = """
async ([url, columns, rows, across]) => {
  const { WhepClient } = await import('/web/whep.js');
  const video = document.getElementById('video');
  window.seen = [];
  window.failures = [];
  const means = async (frame) => {
    const block = frame.codedWidth / across;
    const even = (value) => Math.ceil(value / 2) * 2;
    const rect = { x: 0, y: 0, width: even(columns * block), height: even(rows * block) };
    const pixels = new Uint8Array(frame.allocationSize({ rect }));
    const [{ offset, stride }] = await frame.copyTo(pixels, { rect });
    const edge = (at) => [Math.round((at + 0.25) * block), Math.round((at + 0.75) * block)];
    const found = [];
    for (let row = 0; row < rows; row++) {
      for (let column = 0; column < columns; column++) {
        const [top, bottom] = edge(row), [left, right] = edge(column);
        let sum = 0;
        for (let y = top; y < bottom; y++) for (let x = left; x < right; x++) sum += pixels[offset + y * stride + x];
        found.push(sum / (bottom - top) / (right - left));
      }
    }
    return found;
  };
  const onFrame = (now, metadata) => {
    video.requestVideoFrameCallback(onFrame);
    const frame = new VideoFrame(video);
    means(frame).then((blocks) => window.seen.push({ blocks, now, ...metadata }))
      .catch((error) => window.failures.push(String(error))).finally(() => frame.close());
  };
  video.requestVideoFrameCallback(onFrame);
  window.client = new WhepClient(url);
  window.client.addEventListener('stream', ({ detail }) => { video.srcObject = detail; });
  window.client.start();
}
"""
_TAKE = "() => { const seen = window.seen; window.seen = []; return [seen, window.failures]; }"
_CLOCK = "() => performance.timeOrigin + performance.now()"
_STATS = """
async () => {
  for (const report of (await window.client.peer.getStats()).values()) if (report.type === 'inbound-rtp') return report;
  return null;
}
"""


@dataclass(frozen=True)
class Shown:
    """One frame on the screen. Times are seconds of the system's clock, `coded_at` None where no time code was seen."""

    coded_at: float | None
    rtp_timestamp: int | None
    received_at: float | None
    decode_s: float
    called_at: float
    displayed_at: float
    presented: int
    width: int


class LatencyPage:
    """A page of the service's origin that plays `live`, and the browser's clock against this process's."""

    def __init__(self, page: Page, base: str, query: str) -> None:
        """Raises DemoError when the browser's clock is not this machine's."""
        self._page = page
        page.route(f"{base}/{PAGE}", lambda route: route.fulfill(body=_HTML, content_type="text/html"))
        page.goto(f"{base}/{PAGE}")
        self._origin_ms = page.evaluate("performance.timeOrigin")
        self.clock_offset_s, self.clock_error_s = self._compared()
        page.evaluate(_SCRIPT, [f"{base}/whep/live{query}", time_code.COLUMNS, time_code.ROWS, time_code.BLOCKS_ACROSS])

    def _compared(self) -> tuple[float, float]:
        """What the browser's clock is ahead of ours, and by how much that may be wrong: half of the shortest round trip."""
        best = (0.0, float("inf"))
        for _ in range(CLOCK_READINGS):
            before = time.time()
            theirs = self._page.evaluate(_CLOCK) / 1e3
            after = time.time()
            if (after - before) / 2 < best[1]:
                best = (theirs - (before + after) / 2, (after - before) / 2)
        if abs(best[0]) > 1.0:
            raise DemoError(f"the browser's clock is {best[0]:+.3f} s ahead, expected this machine's")
        return best

    def wait(self, seconds: float) -> None:
        self._page.wait_for_timeout(1e3 * seconds)

    def stats(self) -> dict[str, Any]:
        """`inbound-rtp` of getStats."""
        found: dict[str, Any] = self._page.evaluate(_STATS) or {}
        return found

    def take(self) -> list[Shown]:
        """Frames since the last call. Raises DemoError when one could not be read."""
        seen, failures = self._page.evaluate(_TAKE)
        if failures:
            raise DemoError(f"the browser could not read {len(failures)} frames: {failures[0]}")
        return [self._shown(one) for one in seen]

    def _shown(self, one: dict[str, Any]) -> Shown:
        called_at = self._time(one["now"])
        received = one.get("receiveTime")
        return Shown(coded_at=time_code.decoded(one["blocks"], called_at), rtp_timestamp=one.get("rtpTimestamp"),
                     received_at=None if received is None else self._time(received), decode_s=one.get("processingDuration") or 0.0,
                     called_at=called_at, displayed_at=self._time(max(one["expectedDisplayTime"], one["presentationTime"])),
                     presented=one["presentedFrames"], width=one["width"])

    def _time(self, milliseconds: float) -> float:
        return float(self._origin_ms + milliseconds) / 1e3 - self.clock_offset_s


@contextlib.contextmanager
def latency_page(base: str, query: str = "") -> Iterator[LatencyPage]:
    """A fresh headless Chromium with that page. Raises DemoError where there is no playwright or no Chromium."""
    try:
        from playwright.sync_api import Error, sync_playwright
    except ImportError:
        raise DemoError("playwright is not installed, expected `make setup-test`") from None
    with sync_playwright() as playwright:
        try:
            browser = playwright.chromium.launch(executable_path=CHROMIUM, headless=True, args=list(FLAGS))
        except Error as error:
            raise DemoError(f"{CHROMIUM} does not start: {str(error).splitlines()[0]}") from None
        try:
            yield LatencyPage(browser.new_page(viewport={"width": 200, "height": 100}), base, query)
        finally:
            browser.close()

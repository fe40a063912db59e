"""Headless Chromium, and the decoded pixels of a page's video."""

from __future__ import annotations

import base64
import contextlib
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from playwright.sync_api import Page, sync_playwright

CHROMIUM = "/usr/bin/chromium"
FLAGS = [
    "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--use-gl=angle", "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader", "--autoplay-policy=no-user-gesture-required",
    "--disable-features=WebRtcHideLocalIpsWithMdns",
]

READ_VIDEO = """
(selector) => {
  const video = document.querySelector(selector);
  if (!video || !video.videoWidth || video.readyState < 2) return null;
  const canvas = new OffscreenCanvas(video.videoWidth, video.videoHeight);
  const context = canvas.getContext('2d', { willReadFrequently: true });
  context.drawImage(video, 0, 0);
  const { data } = context.getImageData(0, 0, canvas.width, canvas.height);
  let text = '';
  for (let at = 0; at < data.length; at += 32768) text += String.fromCharCode(...data.subarray(at, at + 32768));
  return { width: canvas.width, height: canvas.height, pixels: btoa(text), time: video.currentTime };
}
"""


@contextlib.contextmanager
def chromium_page(width: int = 480, height: int = 300) -> Iterator[Page]:
    """A fresh browser with one page. `page.console_errors` collects what the page complains about."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, headless=True, args=FLAGS)
        try:
            page = browser.new_page(viewport={"width": width, "height": height})
            page.set_default_timeout(30_000)
            yield page
        finally:
            browser.close()


def video_pixels(page: Page, selector: str = "#video") -> NDArray[np.uint8] | None:
    """The frame that the video shows now as (height, width, 3) display-coded RGB; None before the first one."""
    read: dict[str, Any] | None = page.evaluate(READ_VIDEO, selector)
    if read is None:
        return None
    data = np.frombuffer(base64.b64decode(read["pixels"]), np.uint8)
    return data.reshape(read["height"], read["width"], 4)[..., :3]

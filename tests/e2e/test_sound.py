"""The source's sound in Chromium: there when it is there, and together with its picture."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from browser_page import chromium_page
from processes import wait_for
from running_service import Service

from tests.worker.flash_and_beep import write_clip

pytestmark = [pytest.mark.e2e, pytest.mark.alone]

IN_SYNC_MS = 45             # EBU R37 and ITU-R BT.1359 are about this strict
SETTLING_S = 9.0            # Chromium moves its play-out by so many milliseconds a second until both are together

LISTEN = """
async () => {
  const peer = new RTCPeerConnection();
  const video = document.createElement('video');
  const seen = window.seen = { flashes: [], beeps: [], frames: 0, peer };
  const receivers = ['video', 'audio'].map((kind) => peer.addTransceiver(kind, { direction: 'recvonly' }).receiver);
  receivers[0].jitterBufferTarget = 0;
  await peer.setLocalDescription(await peer.createOffer());
  const response = await fetch('/whep/live', {
    method: 'POST', headers: { 'Content-Type': 'application/sdp' }, body: peer.localDescription.sdp });
  const track = new Promise((resolve) => peer.addEventListener('track', ({ streams }) => resolve(streams[0])));
  await peer.setRemoteDescription({ type: 'answer', sdp: await response.text() });
  video.srcObject = await track;
  await video.play();

  const context = new OffscreenCanvas(1, 1).getContext('2d', { willReadFrequently: true });
  let bright = false;
  const look = (now, { presentationTime }) => {
    seen.frames += 1;
    context.drawImage(video, 0, 0, 1, 1);
    const white = context.getImageData(0, 0, 1, 1).data[0] > 150;
    if (white && !bright) seen.flashes.push(presentationTime);
    bright = white;
    video.requestVideoFrameCallback(look);
  };
  video.requestVideoFrameCallback(look);

  const audio = new AudioContext();
  const analyser = audio.createAnalyser();
  audio.createMediaStreamSource(video.srcObject).connect(analyser);
  const samples = new Float32Array(analyser.fftSize);
  setInterval(() => {
    analyser.getFloatTimeDomainData(samples);
    const first = samples.findIndex((value) => Math.abs(value) > 0.1);
    const at = performance.now() - 1000 * (samples.length - first) / audio.sampleRate;
    if (first > 0 && at - (seen.beeps.at(-1) ?? 0) > 500) seen.beeps.push(at);
  }, 5);
}
"""
SEEN = "({ flashes: seen.flashes, beeps: seen.beeps, frames: seen.frames })"


def skews(seen: dict[str, Any], after: float) -> list[float]:
    """Of each flash: by how many milliseconds its beep is late. `after` is of the page's clock."""
    found = []
    for flash in seen["flashes"]:
        beep = min(seen["beeps"], key=lambda at: abs(at - flash), default=None)
        if flash > after and beep is not None and abs(beep - flash) < 400:
            found.append(beep - flash)
    return found


def test_flash_and_beep_reach_the_viewer_together(start_service: Callable[..., Service], tmp_path: Path) -> None:
    clip = write_clip(tmp_path / "flash.mp4", seconds=10)
    service = start_service("--source", f"file://{clip}")
    service.wait_live()
    assert service.stream()["input"]["audio"]["codec"] == "aac"
    with chromium_page() as page:
        page.goto(f"{service.url}/")
        page.evaluate(LISTEN)
        time.sleep(SETTLING_S)
        settled = page.evaluate("performance.now()")
        wait_for("five flashes and their beeps", lambda: len(skews(page.evaluate(SEEN), settled)) >= 5, 30)
        together = skews(page.evaluate(SEEN), settled)
    assert abs(statistics.median(together)) < IN_SYNC_MS, together


def test_a_source_without_sound_is_silent(start_service: Callable[..., Service], clip: Path) -> None:
    service = start_service("--source", f"file://{clip}")
    service.wait_live()
    assert service.stream()["input"]["audio"] is None
    with chromium_page() as page:
        page.goto(f"{service.url}/")
        page.evaluate(LISTEN)
        wait_for("pictures", lambda: page.evaluate(SEEN)["frames"] > 20, 20)
        assert page.evaluate(SEEN)["beeps"] == []

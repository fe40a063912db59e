"""The source's sound in Chromium: there when it is there, and together with its picture."""

from __future__ import annotations

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
TOGETHER_WITHIN_S = 45      # Chromium moves its play-out by some milliseconds a second until both are together

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


def skews(seen: dict[str, Any]) -> list[float]:
    """Of each flash: by how many milliseconds its beep is late."""
    found = []
    for flash in seen["flashes"]:
        beep = min(seen["beeps"], key=lambda at: abs(at - flash), default=None)
        if beep is not None and abs(beep - flash) < 400:
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
        newest: list[float] = []

        def in_sync() -> bool:
            """Five flashes one after the other, each with its beep."""
            newest[:] = skews(page.evaluate(SEEN))[-5:]
            return len(newest) == 5 and max(map(abs, newest)) < IN_SYNC_MS

        try:
            wait_for("five flashes together with their beeps", in_sync, TOGETHER_WITHIN_S, pause=0.5)
        except AssertionError as error:
            raise AssertionError(f"{error}: beeps are late by {newest} ms") from None


def test_a_source_without_sound_is_silent(start_service: Callable[..., Service], clip: Path) -> None:
    service = start_service("--source", f"file://{clip}")
    service.wait_live()
    assert service.stream()["input"]["audio"] is None
    with chromium_page() as page:
        page.goto(f"{service.url}/")
        page.evaluate(LISTEN)
        wait_for("pictures", lambda: page.evaluate(SEEN)["frames"] > 20, 20)
        assert page.evaluate(SEEN)["beeps"] == []

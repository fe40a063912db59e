"""Camera → gst-rtsp-server → service → Chromium, and the publisher's way into an RTSP server."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import av
import pytest
from media_servers import Publisher, RtspRecorder, RtspServer
from placed_objects import check_objects_follow_rest
from playwright.sync_api import Page
from processes import wait_for
from running_service import Service

pytestmark = pytest.mark.e2e


def test_a_browser_sees_what_rest_places_in_an_rtsp_stream(
        rtsp_server: RtspServer, service: Service, page: Page, clip: Path) -> None:
    service.pull(rtsp_server.url)
    check_objects_follow_rest(page, service, clip)
    stream = service.stream()
    assert stream["flags"] == []
    assert stream["worker"]["restarts"] == 0


def test_publish_feeds_an_rtsp_server(publisher: Callable[..., Publisher], clip: Path, tmp_path: Path) -> None:
    recorder = RtspRecorder(tmp_path)
    try:
        camera = publisher(clip, recorder.url)
        wait_for("recorded video", lambda: recorder.file.exists() and recorder.file.stat().st_size > 500_000, 30)
        assert camera.process.stop() == 0
    finally:
        recorder.process.stop()
    frames, broken = [], 0
    with av.open(str(recorder.file)) as recorded:
        for packet in recorded.demux(video=0):
            try:
                frames += packet.decode()
            except av.error.InvalidDataError:
                broken += 1
    assert broken <= 1, "the recorder may be stopped in the middle of its last picture, not more"
    assert len(frames) > 5
    assert {(frame.width, frame.height) for frame in frames} == {(1024, 512)}

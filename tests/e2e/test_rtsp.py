"""Camera → gst-rtsp-server → service → Chromium."""

from __future__ import annotations

from pathlib import Path

import pytest
from media_servers import RtspServer
from placed_objects import check_objects_follow_rest
from playwright.sync_api import Page
from running_service import Service

pytestmark = pytest.mark.e2e


def test_a_browser_sees_what_rest_places_in_an_rtsp_stream(
        rtsp_server: RtspServer, service: Service, page: Page, clip: Path) -> None:
    service.pull(rtsp_server.url)
    check_objects_follow_rest(page, service, clip)
    stream = service.stream()
    assert stream["flags"] == []
    assert stream["worker"]["restarts"] == 0

"""Camera → nginx-rtmp → service → Chromium."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from media_servers import NginxRtmp, Publisher
from placed_objects import check_objects_follow_rest
from playwright.sync_api import Page
from running_service import Service

pytestmark = pytest.mark.e2e


def test_a_browser_sees_what_rest_places_in_an_rtmp_stream(
        nginx_rtmp: NginxRtmp, publisher: Callable[..., Publisher], service: Service, page: Page, clip: Path) -> None:
    publisher(clip, nginx_rtmp.url("camera"))
    service.pull(nginx_rtmp.url("camera"))
    check_objects_follow_rest(page, service, clip)
    stream = service.stream()
    assert stream["flags"] == []
    assert (stream["input"]["width"], stream["input"]["height"]) == (1024, 512)
    assert stream["viewers"] == 1
    assert stream["worker"]["restarts"] == 0

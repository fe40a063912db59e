"""The light WebSocket against the demo camera's known sun, while it crosses the seam behind the camera."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from media_servers import Publisher
from processes import free_port
from running_service import Service
from websockets.sync.client import connect

from server.demo.camera import sun_direction

pytestmark = pytest.mark.e2e

SEAM_PTS_S = 5.0        # when the synthetic sun stands exactly behind the camera
LAST_PTS_S = 7.5
LIMIT_S = 90.0


def test_lights_follow_the_sun_across_the_seam(service: Service, publisher: Callable[..., Publisher],
                                               clip: Path) -> None:
    port = free_port()
    service.pull(f"rtmp-listen://127.0.0.1:{port}/live/camera", wait=False)
    url = service.url.replace("http", "ws") + "/api/streams/live/lights"
    with connect(url, proxy=None) as socket:
        publisher(clip, f"rtmp://127.0.0.1:{port}/live/camera")
        messages = receive_until(socket, LAST_PTS_S)
    frames = [message["frame"] for message in messages]
    assert frames == sorted(set(frames))
    before = [message for message in messages if message["pts"] < SEAM_PTS_S]
    after = [message for message in messages if message["pts"] > SEAM_PTS_S]
    assert len(before) >= 10
    assert len(after) >= 10
    errors = [angle_to_sun(message, strongest(message)["direction"]) for message in messages]
    assert max(errors) < 1.0, f"worst {max(errors):.2f}°, mean {np.mean(errors):.2f}°"
    primary = [angle_to_sun(message, message["primaryLightDirection"]) for message in messages]
    assert max(primary) < 1.0
    assert len({strongest(message)["id"] for message in messages}) == 1, "the sun changed its id at the seam"


def receive_until(socket: Any, last_pts: float) -> list[dict[str, Any]]:
    limit = time.monotonic() + LIMIT_S
    messages: list[dict[str, Any]] = []
    while not messages or messages[-1]["pts"] < last_pts:
        messages.append(json.loads(socket.recv(timeout=limit - time.monotonic())))
    return messages


def strongest(message: dict[str, Any]) -> dict[str, Any]:
    assert message["lights"], f"no light at pts {message['pts']}"
    found: dict[str, Any] = max(message["lights"], key=lambda light: sum(light["irradiance"]))
    return found


def angle_to_sun(message: dict[str, Any], direction: list[float]) -> float:
    """Degrees between a direction of a message and the sun in that message's frame."""
    sun = np.array(sun_direction(message["pts"]))
    assert np.linalg.norm(direction) == pytest.approx(1, abs=1e-3)
    return math.degrees(math.acos(min(1.0, float(np.dot(direction, sun)))))

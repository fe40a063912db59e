"""A source whose pictures cannot be read: the stream says so and goes on waiting."""

from __future__ import annotations

import time
from queue import SimpleQueue
from typing import Any

import pytest
from av.video.frame import VideoFrame

from renderer.gl import Context
from server.worker import compositor
from server.worker.render_loop import RenderLoop
from server.worker.source import Decoded


def decoded(pix_fmt: str) -> Decoded:
    frame = VideoFrame(64, 32, pix_fmt)
    for plane in frame.planes:
        plane.update(bytes(plane.buffer_size))
    return Decoded(frame, 0.0, time.monotonic(), time.time())


def test_a_format_that_cannot_be_converted_is_reported_and_does_not_end_the_worker(monkeypatch: pytest.MonkeyPatch) -> None:
    sent: list[dict[str, Any]] = []
    monkeypatch.setattr(compositor, "warm_up", lambda *_: None)     # nothing is drawn here
    context = Context()
    loop = RenderLoop({"stream": "live"}, context, SimpleQueue(), lambda message, _: sent.append(message))
    loop._heart.start()
    try:
        loop._process(decoded("y210be"))
        state = [message for message in sent if message["type"] == "state"][-1]
        assert state["source"] == "lost"
        assert "pixel format 'y210be' cannot be converted" in state["detail"]
        assert "converted" in state["flags"]
        loop._process(decoded("yuv420p10le"))
        assert loop._last is not None
        assert loop._last[0].size == (64, 32)
    finally:
        loop.close()
        context.release()

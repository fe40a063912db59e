"""VP8 by libvpx, for browsers that have no H.264 (open builds of Chromium, some WebViews)."""

from __future__ import annotations

from typing import ClassVar

from av.video.frame import VideoFrame

from renderer.color import YuvFormat
from server.worker.h264 import encode_frame, new_context

FINEST_QUANTIZER = 8        # of 0 to 63: finer steps would spend the bitrate, and half the time, on the camera's noise
SPEED = 12                  # libvpx's cpu-used: 8 takes a third longer at 2048x1024 for the same picture
KEYFRAME_SHARE = 600        # percent of a frame's mean share of the bitrate that a keyframe may take


class Vp8Encoder:
    """Real-time, one packet a frame at once, no hidden reference frames."""

    COLOURS: ClassVar[YuvFormat | None] = YuvFormat("bt601", False)     # it has no tags: RFC 6386 (9.2) and Chromium assume this

    def __init__(self, size: tuple[int, int], fps: float, bitrate_bps: int, layout: YuvFormat) -> None:
        if layout != self.COLOURS:
            raise ValueError(f"colours are {layout}, expected {self.COLOURS}")
        context = new_context("libvpx", size, fps, bitrate_bps)
        context.thread_count = 1
        context.options = {"deadline": "realtime", "cpu-used": str(SPEED), "lag-in-frames": "0", "auto-alt-ref": "0",
                           "error-resilient": "default", "qmin": str(FINEST_QUANTIZER), "max-intra-rate": str(KEYFRAME_SHARE),
                           "minrate": str(bitrate_bps), "maxrate": str(bitrate_bps), "bufsize": str(bitrate_bps // 2)}
        self._context = context

    def encode(self, frame: VideoFrame, timestamp: int, *, keyframe: bool) -> list[tuple[bytes, bool]]:
        """VP8 frames (RFC 6386) and whether each is a keyframe. `timestamp` is in units of 1 / 90000 s."""
        return encode_frame(self._context, frame, timestamp, keyframe=keyframe)

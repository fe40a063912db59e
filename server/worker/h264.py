"""H.264 by libx264, for viewers over WebRTC: no delay, a bounded bitrate, decodable by everything."""

from __future__ import annotations

from fractions import Fraction
from typing import ClassVar

import av
from av.video.codeccontext import VideoCodecContext
from av.video.frame import PictureType, VideoFrame

from renderer.color import YuvFormat
from server.worker.output_clock import CLOCK_RATE

KEYFRAME_INTERVAL_S = 2.0
FINEST_QP = 16           # finer steps would spend what is left of the bitrate on the camera's noise
SINGLE_THREAD_PIXELS = 2300 * 1150


def default_bitrate(width: int, height: int) -> int:
    """Bits per second by geometry: 12 Mbps at 2048x1024, 30 Mbps at 3840x1920, in between and beyond by a power law."""
    return int(12e6 * max(width * height / (2048 * 1024), 0.05) ** 0.73)


class H264Encoder:
    """Constrained baseline. The level follows from the geometry; SPS and PPS stand before every IDR."""

    COLOURS: ClassVar[YuvFormat | None] = None        # any: matrix and range are in the SPS

    def __init__(self, size: tuple[int, int], fps: float, bitrate_bps: int, layout: YuvFormat) -> None:
        context = new_context("libx264", size, fps, bitrate_bps)
        # a second thread costs more in switching than it saves while the renderer wants both cores, and slices cost bits
        context.thread_count = 1 if size[0] * size[1] <= SINGLE_THREAD_PIXELS else 2
        context.colorspace = context.color_primaries = context.color_trc = 1 if layout.matrix == "bt709" else 6
        context.color_range = 2 if layout.full_range else 1
        context.options = {"preset": "ultrafast", "tune": "zerolatency", "profile": "baseline", "forced-idr": "1",
                           "maxrate": str(bitrate_bps), "bufsize": str(bitrate_bps // 4),
                           "x264-params": f"scenecut=0:qpmin={FINEST_QP}"}
        self._context = context

    def encode(self, frame: VideoFrame, timestamp: int, *, keyframe: bool) -> list[tuple[bytes, bool]]:
        """Access units in Annex B and whether each is a keyframe. `timestamp` is in units of 1 / 90000 s."""
        return encode_frame(self._context, frame, timestamp, keyframe=keyframe)


def new_context(codec: str, size: tuple[int, int], fps: float, bitrate_bps: int) -> VideoCodecContext:
    """What the video encoders have in common: geometry, clock, bitrate, distance of keyframes, no reordering."""
    rate = Fraction(max(1.0, fps)).limit_denominator(1001)
    context = av.CodecContext.create(codec, "w")
    assert isinstance(context, VideoCodecContext)
    context.width, context.height = size
    context.pix_fmt = "yuv420p"
    context.time_base = Fraction(1, CLOCK_RATE)
    context.framerate = rate
    context.bit_rate = bitrate_bps
    context.gop_size = max(1, round(float(rate) * KEYFRAME_INTERVAL_S))
    context.max_b_frames = 0
    return context


def encode_frame(context: VideoCodecContext, frame: VideoFrame, timestamp: int, *, keyframe: bool) -> list[tuple[bytes, bool]]:
    """The packets that the encoder gives for the frame. Sets time and type of the frame, which must be the caller's own."""
    frame.pts = timestamp
    frame.time_base = Fraction(1, CLOCK_RATE)
    frame.pict_type = PictureType.I if keyframe else PictureType.NONE
    return [(bytes(packet), packet.is_keyframe) for packet in context.encode(frame)]

"""The encode thread: composited pictures in, H.264 access units out. One encoder for all viewers of a stream."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from fractions import Fraction

import av
from av.video.codeccontext import VideoCodecContext
from av.video.frame import PictureType, VideoFrame

from renderer.frame import YuvFrame
from server.worker.named_thread import NamedThread
from server.worker.newest import Newest

CLOCK_RATE = 90_000
KEYFRAME_INTERVAL_S = 2.0
FINEST_QP = 16           # finer steps would spend what is left of the bitrate on the camera's noise
SINGLE_THREAD_PIXELS = 2300 * 1150
MIN_KEYFRAME_DISTANCE_S = 0.5      # between two keyframes on request


@dataclass(frozen=True)
class Composited:
    """A picture on its way to the encoder; `timestamp` is in units of 1 / 90000 s, `video` the frame that the planes lie in."""

    picture: YuvFrame
    video: VideoFrame
    frame: int
    timestamp: int
    decoded_at: float
    render_ms: float
    stages_ms: dict[str, float] = field(default_factory=dict)
    revision: int = 0       # of the scene in it


OnPacket = Callable[[bytes, bool, Composited], None]


def default_bitrate(width: int, height: int) -> int:
    """Bits per second by geometry: 12 Mbps at 2048x1024, 30 Mbps at 3840x1920, in between and beyond by a power law."""
    return int(12e6 * max(width * height / (2048 * 1024), 0.05) ** 0.73)


class Encoder:
    """libx264, constrained baseline, no delay. The level follows from the geometry; SPS and PPS stand before every IDR."""

    def __init__(self, size: tuple[int, int], fps: float, bitrate_bps: int, *, bt709: bool, full_range: bool) -> None:
        rate = Fraction(max(1.0, fps)).limit_denominator(1001)
        context = av.CodecContext.create("libx264", "w")
        assert isinstance(context, VideoCodecContext)
        context.width, context.height = size
        context.pix_fmt = "yuv420p"
        context.time_base = Fraction(1, CLOCK_RATE)
        context.framerate = rate
        context.bit_rate = bitrate_bps
        context.gop_size = max(1, round(float(rate) * KEYFRAME_INTERVAL_S))
        context.max_b_frames = 0
        # a second thread costs more in switching than it saves while the renderer wants both cores, and slices cost bits
        context.thread_count = 1 if size[0] * size[1] <= SINGLE_THREAD_PIXELS else 2
        context.colorspace = context.color_primaries = 1 if bt709 else 6
        context.color_trc = 1 if bt709 else 6
        context.color_range = 2 if full_range else 1
        context.options = {"preset": "ultrafast", "tune": "zerolatency", "profile": "baseline", "forced-idr": "1",
                           "maxrate": str(bitrate_bps), "bufsize": str(bitrate_bps // 4),
                           "x264-params": f"scenecut=0:qpmin={FINEST_QP}"}
        self._context = context

    def encode(self, item: Composited, *, keyframe: bool) -> list[tuple[bytes, bool]]:
        """Access units in Annex B and whether each is a keyframe."""
        frame = item.video
        frame.pts = item.timestamp
        frame.time_base = Fraction(1, CLOCK_RATE)
        frame.pict_type = PictureType.I if keyframe else PictureType.NONE
        return [(bytes(packet), packet.is_keyframe) for packet in self._context.encode(frame)]


class EncodeThread:
    """Encodes the newest picture; what comes faster than that is dropped before the encoder and counted."""

    def __init__(self, on_packet: OnPacket) -> None:
        self._on_packet = on_packet
        self.pictures: Newest[Composited] = Newest()
        self.frames_encoded = 0
        self.fps = 30.0
        self._bitrate: int | None = None
        self._encoder: Encoder | None = None
        self._key: object = None
        self._keyframe_wanted = True
        self._last_keyframe = -1e9
        self._stopped = False
        self.error: BaseException | None = None
        self._thread = NamedThread(target=self._run, name="encode", daemon=True)
        self._thread.start()

    def request_keyframe(self) -> None:
        self._keyframe_wanted = True

    def set_bitrate(self, bps: int | None) -> None:
        """None: by geometry."""
        self._bitrate = bps

    def bitrate(self, size: tuple[int, int]) -> int:
        return self._bitrate or default_bitrate(*size)

    def _run(self) -> None:
        try:
            while not self._stopped:
                item = self.pictures.take(timeout=0.5)
                if item is not None:
                    self._encode(item)
        except BaseException as error:  # the main thread reports it and ends the worker
            self.error = error

    def _encode(self, item: Composited) -> None:
        layout = item.picture.format
        key = (item.picture.size, layout, self.bitrate(item.picture.size), round(self.fps))
        if key != self._key:
            self._encoder = Encoder(item.picture.size, self.fps, key[2], bt709=layout.matrix == "bt709",
                                    full_range=layout.full_range)
            self._key = key
        assert self._encoder is not None
        now = time.monotonic()
        keyframe = self._keyframe_wanted and now - self._last_keyframe >= MIN_KEYFRAME_DISTANCE_S
        if keyframe:
            self._keyframe_wanted = False
            self._last_keyframe = now
        for payload, is_keyframe in self._encoder.encode(item, keyframe=keyframe):
            self.frames_encoded += 1
            self._on_packet(payload, is_keyframe, item)

    def stop(self) -> None:
        self._stopped = True
        self.pictures.wake()
        self._thread.join(2.0)

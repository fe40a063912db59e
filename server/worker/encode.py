"""The encode thread of one track: composited pictures in, packets out. One encoder for all who take the track."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import ClassVar, NamedTuple, Protocol

from av.video.frame import VideoFrame

from renderer.color import YuvFormat
from renderer.frame import YuvFrame
from server.worker.h264 import H264Encoder, default_bitrate
from server.worker.named_thread import NamedThread
from server.worker.newest import Newest
from server.worker.scaler import Scaler
from server.worker.statistics import TrackStatistics
from server.worker.vp8 import Vp8Encoder

MIN_KEYFRAME_DISTANCE_S = 0.5      # between two keyframes on request


@dataclass(frozen=True)
class Composited:
    """A picture on its way to the encoders; `timestamp` is in units of 1 / 90000 s, `video` the frame that the planes lie in."""

    picture: YuvFrame
    video: VideoFrame
    frame: int
    timestamp: int
    decoded_at: float
    render_ms: float
    stages_ms: dict[str, float] = field(default_factory=dict)
    revision: int = 0       # of the scene in it


class Plan(NamedTuple):
    """What an encoder is to make of the pictures."""

    size: tuple[int, int]
    fps: int
    bitrate_bps: int


class VideoEncoder(Protocol):
    COLOURS: ClassVar[YuvFormat | None]     # matrix and range that it takes; None: any

    def __init__(self, size: tuple[int, int], fps: float, bitrate_bps: int, layout: YuvFormat) -> None: ...

    def encode(self, frame: VideoFrame, timestamp: int, *, keyframe: bool) -> list[tuple[bytes, bool]]: ...


ENCODERS: dict[str, type[VideoEncoder]] = {"h264": H264Encoder, "vp8": Vp8Encoder}
OnPacket = Callable[[bytes, bool, Composited], None]
Planner = Callable[[tuple[int, int]], Plan]     # by the size of the full picture


def full_plan(size: tuple[int, int], fps: float = 30.0) -> Plan:
    """The picture as it is, at the bitrate that its geometry asks for."""
    return Plan(size, round(fps), default_bitrate(*size))


class EncodeThread:
    """Encodes the newest picture; what comes faster than that is dropped before the encoder and counted.

    `plan` is asked before every picture, and a new encoder made when its answer is another.
    """

    def __init__(self, on_packet: OnPacket, *, plan: Planner = full_plan, codec: str = "h264",
                 name: str = "full/h264 enc") -> None:
        self._on_packet = on_packet
        self._plan = plan
        self._make = ENCODERS[codec]
        self.pictures: Newest[Composited] = Newest()
        self.statistics = TrackStatistics()
        self._scaler: Scaler | None = None
        self._encoder: VideoEncoder | None = None
        self._key: object = None
        self._requests = 0          # counted up by others, compared with what has been served
        self._served = 0
        self._last_keyframe = -1e9
        self._stopped = False
        self.error: BaseException | None = None
        self._thread = NamedThread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def request_keyframe(self) -> None:
        """Make the next picture a keyframe, or, soon after another keyframe, the first one after the pause."""
        self._requests += 1

    def _run(self) -> None:
        try:
            while not self._stopped:
                self._encode_next()
        except BaseException as error:  # the main thread reports it and ends the worker
            self.error = error
        finally:
            self._encoder = self._scaler = None

    def _encode_next(self) -> None:
        """In a function of its own: while the thread waits for the next picture it holds none."""
        item = self.pictures.take(timeout=0.5)
        if item is not None and not self._stopped:
            self._encode(item)

    def _encode(self, item: Composited) -> None:
        started = time.monotonic()
        self._prepare(item.picture)
        assert self._encoder is not None
        assert self._scaler is not None
        requests = self._requests
        wanted = requests != self._served and started - self._last_keyframe >= MIN_KEYFRAME_DISTANCE_S
        packets = self._encoder.encode(self._scaler.frame(item.video), item.timestamp, keyframe=wanted)
        for payload, is_keyframe in packets:
            if is_keyframe:     # whatever made it one, it serves all who asked before
                self._served, self._last_keyframe = requests, started
            self.statistics.add((time.monotonic() - started) * 1e3, len(payload), is_keyframe=is_keyframe)
            self._on_packet(payload, is_keyframe, item)

    def _prepare(self, picture: YuvFrame) -> None:
        plan = self._plan(picture.size)
        key = (picture.size, picture.format, plan)
        if key != self._key:
            layout = self._make.COLOURS or picture.format
            self._scaler = Scaler(picture.size, plan.size, picture.format, layout)
            self._encoder = self._make(plan.size, plan.fps, plan.bitrate_bps, layout)
            self._key = key

    def stop(self, join_timeout: float = 2.0) -> None:
        """Ends the thread, and its encoder with it."""
        self._stopped = True
        self.pictures.wake()
        self._thread.join(join_timeout)

    @property
    def alive(self) -> bool:
        return self._thread.is_alive()

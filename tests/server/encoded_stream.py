"""A stream of the tests: real x264 and libopus packets in real fan-outs, at the pace of a clock. Each second begins with a white
picture and a beep."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Iterator
from fractions import Fraction
from typing import Any

import av
import numpy as np

from renderer.color import YuvFormat
from server.delivery.fanout import EncodedFrame
from server.delivery.tracks import Tracks
from server.renditions import AUDIO
from server.worker.h264 import H264Encoder
from server.worker.picture import FramePool

SIZE = (256, 128)
FPS = 15
FLASH_S = 0.2
FIRST_TIMESTAMP = 900_000       # a stream that has been running for 10 s


class EncodedStream:
    """What an output asks of its stream. `async with EncodedStream(speed=4) as stream:`; `speed` by real time."""

    name = "live"
    rendition_names = ("full",)

    def __init__(self, *, speed: float = 1.0, sound: bool = False, size: tuple[int, int] = SIZE) -> None:
        self.tracks = Tracks(request_keyframe=self._request_keyframe, demand_changed=lambda: None)
        self.keyframe_requests = 0
        self.revision = 1
        self._size, self._speed, self._sound = size, speed, sound
        self._keyframe_wanted = True
        self._task: asyncio.Task[None] | None = None

    @property
    def input(self) -> dict[str, Any]:
        """As in the stream's state."""
        return {"audio": {"codec": "opus", "sample_rate": 48_000, "channels": 2} if self._sound else None}

    def scene_of(self, revision: int) -> dict[str, Any] | None:
        return {"revision_of_the_test": revision}

    async def __aenter__(self) -> EncodedStream:
        self._task = asyncio.create_task(self._run())
        return self

    async def __aexit__(self, *error: object) -> None:
        assert self._task is not None
        self._task.cancel()
        await asyncio.wait([self._task])
        if not self._task.cancelled():
            self._task.result()

    def _request_keyframe(self, track: str) -> None:
        self.keyframe_requests += 1
        self._keyframe_wanted = True

    async def _run(self) -> None:
        sound = opus_packets(1e6)
        waiting = next(sound)
        started = time.monotonic()
        for frame in pictures(1e6, size=self._size, keyframe=self._take_keyframe_request):
            seconds = (frame.timestamp - FIRST_TIMESTAMP) / 90_000
            await asyncio.sleep(max(0.0, started + seconds / self._speed - time.monotonic()))
            frame.decoded_at, frame.scene_revision = time.monotonic(), self.revision
            self.tracks.publish("full/h264", frame)
            while (waiting.timestamp - FIRST_TIMESTAMP * 8 // 15) / 48_000 < seconds + 1 / FPS:
                if self._sound:
                    self.tracks.publish(AUDIO, waiting)
                waiting = next(sound)

    def _take_keyframe_request(self) -> bool:
        wanted, self._keyframe_wanted = self._keyframe_wanted, False
        return wanted


def pictures(seconds: float, *, size: tuple[int, int] = SIZE,
             keyframe: Callable[[], bool] = lambda: False) -> Iterator[EncodedFrame]:
    """As the worker encodes them; `keyframe` is asked before each."""
    layout = YuvFormat("bt709", False)
    encoder, pool = H264Encoder(size, FPS, 1_000_000, layout), FramePool(size)
    for number in range(round(seconds * FPS)):
        picture, video = pool.take(layout)
        white = number / FPS % 1.0 < FLASH_S - 1e-6
        picture.y[...] = 235 if white else 60
        picture.u[...], picture.v[...] = 128, 128
        timestamp = FIRST_TIMESTAMP + round(number * 90_000 / FPS)
        for data, is_keyframe in encoder.encode(video, timestamp, keyframe=keyframe()):
            yield EncodedFrame(data, timestamp, keyframe=is_keyframe, decoded_at=time.monotonic())


def opus_packets(seconds: float, *, always: bool = False) -> Iterator[EncodedFrame]:
    """The beeps, or one that never ends."""
    opus = _opus_encoder()
    for first in range(0, round(seconds * 48_000), 960):
        for packet in opus.encode(_beep(first, always=always)):
            yield EncodedFrame(bytes(packet), FIRST_TIMESTAMP * 8 // 15 + first, keyframe=True, decoded_at=time.monotonic())


def _opus_encoder() -> Any:
    context: Any = av.CodecContext.create("libopus", "w")
    context.sample_rate, context.layout, context.format = 48_000, "stereo", "flt"
    context.time_base = Fraction(1, 48_000)
    return context


def _beep(first: int, *, always: bool) -> av.AudioFrame:
    seconds = (first + np.arange(960)) / 48_000
    tone = np.where(always | (seconds % 1.0 < FLASH_S), 0.5 * np.sin(2 * np.pi * 1000 * seconds), 0.0)
    frame = av.AudioFrame.from_ndarray(np.repeat(tone, 2)[None].astype(np.float32), format="flt", layout="stereo")
    frame.sample_rate, frame.pts, frame.time_base = 48_000, first, Fraction(1, 48_000)
    return frame


def flash_times(pictures: list[tuple[float, float]]) -> list[float]:
    """When the picture turns white, of (seconds, mean luma)."""
    return [time for (time, luma), (_, before) in zip(pictures[1:], pictures, strict=False) if luma > 150 > before]


def beep_times(samples: np.ndarray, first_s: float) -> list[float]:
    """When the beep begins, in 48 kHz mono."""
    loud = np.abs(samples) > 0.1
    quiet_before = np.convolve(loud, np.ones(9600), "full")[:len(loud)] - loud < 1      # nothing for 0.2 s
    return [first_s + index / 48_000 for index in np.flatnonzero(loud & quiet_before)]

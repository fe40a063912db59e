"""One encoded track to many takers: frames are shared, every taker has a bounded queue of its own.

A taker of video starts at a keyframe. One that is too slow is cut to the next keyframe: its queue is emptied, what follows is
dropped and counted until a keyframe comes. Nobody waits for anybody.
"""

from __future__ import annotations

import asyncio
import time
from collections import deque
from collections.abc import Callable

from server.delivery.byte_rate import ByteRate

MAX_QUEUED_FRAMES = 32      # a second at 30 fps; more would only be latency


class EncodedFrame:
    """One access unit of an encoded track, or one packet of sound; the same object for every taker.

    `timestamp` counts ticks of the track's RTP clock (video 90 kHz, sound 48 kHz) since the stream began; it grows for ever, only
    RTP cuts it to 32 bits. `decoded_at` is `time.monotonic()` when the decoder gave the source frame.
    """

    __slots__ = ("data", "decoded_at", "keyframe", "payloads", "scene_revision", "timestamp")

    def __init__(self, data: bytes, timestamp: int, *, keyframe: bool, decoded_at: float, scene_revision: int = 0) -> None:
        self.data = data
        self.timestamp = timestamp
        self.keyframe = keyframe
        self.decoded_at = decoded_at
        self.scene_revision = scene_revision        # of the scene that is seen in it
        self.payloads: list[bytes] | None = None    # RTP payloads, packed once by the first viewer that sends it

    def moved_to(self, timestamp: int) -> EncodedFrame:
        """The same frame at another time."""
        moved = EncodedFrame(self.data, timestamp, keyframe=self.keyframe, decoded_at=self.decoded_at,
                             scene_revision=self.scene_revision)
        moved.payloads = self.payloads
        return moved


class Taker:
    """The queue of one taker. `next_frame` has one caller.

    A viewer that is being switched to another track holds two takers, which then share the event that says that something came.
    """

    def __init__(self, request_keyframe: Callable[[], None], *, needs_keyframe: bool = True,
                 filled: asyncio.Event | None = None) -> None:
        self.delivered = 0
        self.dropped = 0
        self._request_keyframe = request_keyframe
        self._queue: deque[EncodedFrame] = deque()
        self._filled = filled or asyncio.Event()
        self._needs_keyframe = needs_keyframe
        self._overflowed = False

    async def next_frame(self) -> EncodedFrame:
        while not self._queue:
            self._filled.clear()
            await self._filled.wait()
        return self.take()

    @property
    def head(self) -> EncodedFrame | None:
        """The frame that `take` would return."""
        return self._queue[0] if self._queue else None

    def take(self) -> EncodedFrame:
        """Raises IndexError when there is none."""
        self.delivered += 1
        return self._queue.popleft()

    def offer(self, frame: EncodedFrame) -> int:
        """Queue the frame, or drop it. Returns the number of frames lost to slowness by this call."""
        lost = 0
        if len(self._queue) >= MAX_QUEUED_FRAMES:
            lost = len(self._queue)
            self._queue.clear()
            self._needs_keyframe = self._overflowed = True
            if not frame.keyframe:
                self._request_keyframe()
        if self._needs_keyframe and not frame.keyframe:
            lost += self._overflowed        # before the first keyframe there was nothing to lose
        else:
            self._needs_keyframe = self._overflowed = False
            self._queue.append(frame)
            self._filled.set()
        self.dropped += lost
        return lost

    def start_at_keyframe(self) -> None:
        """The next frame queued must be a keyframe: the encoder behind the track has changed."""
        self._needs_keyframe = True


class FanOut:
    """All takers of one track. Sound has `keyframes=False`: each of its frames counts as one."""

    def __init__(self, *, request_keyframe: Callable[[], None], takers_changed: Callable[[], None], keyframes: bool = True) -> None:
        self.dropped = 0
        self.rate = ByteRate()
        self._delivered_before = 0          # to takers that have left
        self._takers: set[Taker] = set()
        self._keyframes = keyframes
        self.request_keyframe = request_keyframe
        self._takers_changed = takers_changed

    def __len__(self) -> int:
        return len(self._takers)

    @property
    def delivered(self) -> int:
        return self._delivered_before + sum(taker.delivered for taker in self._takers)

    def join(self, filled: asyncio.Event | None = None) -> Taker:
        """A new taker; `filled` is set whenever it gets something."""
        taker = Taker(self.request_keyframe, needs_keyframe=self._keyframes, filled=filled)
        self._takers.add(taker)
        self._takers_changed()
        self.request_keyframe()
        return taker

    def leave(self, taker: Taker) -> None:
        if taker in self._takers:
            self._takers.remove(taker)
            self._delivered_before += taker.delivered
            self._takers_changed()

    def publish(self, frame: EncodedFrame) -> None:
        self.rate.add(len(frame.data), time.monotonic())
        for taker in self._takers:
            self.dropped += taker.offer(frame)

    def encoder_replaced(self) -> None:
        """The frames that follow come from another encoder: every taker goes on at its first keyframe."""
        if self._keyframes and self._takers:
            for taker in self._takers:
                taker.start_at_keyframe()
            self.request_keyframe()

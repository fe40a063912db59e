"""One encoded stream to many viewers: packets are shared, every viewer has a bounded queue of its own.

A viewer starts at a keyframe. One that is too slow is cut to the next keyframe: its queue is emptied, what follows is
dropped and counted until a keyframe comes. Nobody waits for anybody.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import av

MAX_QUEUED_FRAMES = 32      # a second at 30 fps; more would only be latency


@dataclass(frozen=True, slots=True)
class EncodedFrame:
    """One access unit, ready for every viewer."""

    packet: av.Packet[av.VideoStream]
    keyframe: bool
    decoded_at: float       # time.monotonic() when the decoder gave the source frame


class Viewer:
    """The queue of one viewer. `next_frame` has one caller."""

    def __init__(self, request_keyframe: Callable[[], None]) -> None:
        self.delivered = 0
        self.dropped = 0
        self._request_keyframe = request_keyframe
        self._queue: deque[EncodedFrame] = deque()
        self._filled = asyncio.Event()
        self._needs_keyframe = True
        self._overflowed = False

    async def next_frame(self) -> EncodedFrame:
        while not self._queue:
            self._filled.clear()
            await self._filled.wait()
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
        """The next frame queued must be a keyframe: the encoder behind the stream has changed."""
        self._needs_keyframe = True


class FanOut:
    """All viewers of one stream."""

    def __init__(self, *, request_keyframe: Callable[[], None], viewers_changed: Callable[[], None]) -> None:
        self.dropped = 0
        self._delivered_before = 0          # by viewers that have left
        self._viewers: set[Viewer] = set()
        self.request_keyframe = request_keyframe
        self._viewers_changed = viewers_changed

    def __len__(self) -> int:
        return len(self._viewers)

    @property
    def delivered(self) -> int:
        return self._delivered_before + sum(viewer.delivered for viewer in self._viewers)

    def join(self) -> Viewer:
        viewer = Viewer(self.request_keyframe)
        self._viewers.add(viewer)
        self._viewers_changed()
        self.request_keyframe()
        return viewer

    def leave(self, viewer: Viewer) -> None:
        if viewer in self._viewers:
            self._viewers.remove(viewer)
            self._delivered_before += viewer.delivered
            self._viewers_changed()

    def publish(self, frame: EncodedFrame) -> None:
        for viewer in self._viewers:
            self.dropped += viewer.offer(frame)

    def encoder_replaced(self) -> None:
        """The packets that follow come from another encoder: every viewer goes on at its first keyframe."""
        for viewer in self._viewers:
            viewer.start_at_keyframe()
        if self._viewers:
            self.request_keyframe()

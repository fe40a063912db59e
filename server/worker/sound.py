"""The sound thread: what the source's sound decoder gives, as Opus packets on the stream's clock. One encoder for all viewers."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable

from server.worker.named_thread import NamedThread
from server.worker.opus import OpusEncoder
from server.worker.output_clock import SOUND_RATE, OutputClock
from server.worker.sound_decoder import Heard
from server.worker.sound_timeline import BLOCK, SoundTimeline

LONGEST_QUEUE = 3 * SOUND_RATE      # samples; the oldest are lost
OnSound = Callable[[bytes, int, float], None]       # packet, ticks of 1 / 48000 s, when its sound was decoded


class Sound:
    """Runs while somebody wants it. Sound that a file brings ahead of its pictures waits for them."""

    def __init__(self, clock: OutputClock, on_packet: OnSound) -> None:
        self._clock = clock
        self._on_packet = on_packet
        self._condition = threading.Condition()
        self._queue: deque[tuple[float, Heard]] = deque()
        self._queued = 0
        self._earliest = 0                  # tick of the next packet: none goes back, whoever makes it
        self._thread: NamedThread | None = None
        self._current: object = None        # what the thread that should run knows itself by
        self.error: BaseException | None = None

    @property
    def wanted(self) -> bool:
        return self._current is not None

    def want(self, wanted: bool) -> None:
        """Start or end the thread, its encoder with it."""
        if wanted == self.wanted:
            return
        with self._condition:
            self._queue.clear()
            self._queued = 0
            self._current = object() if wanted else None
            self._condition.notify_all()
        if wanted:
            self._thread = NamedThread(target=self._run, args=(self._current,), name="sound", daemon=True)
            self._thread.start()

    def put(self, heard: Heard, moment: float) -> None:
        """From any thread, which never waits. `moment` is that of the first sample."""
        with self._condition:
            if self._current is None:
                return
            self._queue.append((moment, heard))
            self._queued += len(heard.samples)
            while self._queued > LONGEST_QUEUE:
                self._queued -= len(self._queue.popleft()[1].samples)
            self._condition.notify_all()

    def _run(self, me: object) -> None:
        timeline, encoder = SoundTimeline(), OpusEncoder()
        try:
            while (item := self._next(me)) is not None:
                moment, heard = item
                for tick, block in timeline.lay(heard.samples, self._clock.sound_ticks(moment)):
                    for packet, first in encoder.encode(block, tick):
                        if first >= self._earliest and self._current is me:
                            self._earliest = first + BLOCK
                            self._on_packet(packet, first, heard.decoded_at)
        except BaseException as error:      # the main thread reports it and ends the worker
            self.error = error

    def _next(self, me: object) -> tuple[float, Heard] | None:
        """The oldest piece, when it is due; None when the thread is to end."""
        with self._condition:
            while self._current is me:
                wait_s = self._clock.due_at(self._queue[0][0]) - time.monotonic() if self._queue else None
                if wait_s is not None and wait_s <= 0:
                    item = self._queue.popleft()
                    self._queued -= len(item[1].samples)
                    return item
                self._condition.wait(wait_s)
        return None

    def close(self) -> None:
        self.want(False)
        if self._thread is not None:
            self._thread.join(1.0)

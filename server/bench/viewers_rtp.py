"""What one viewer receives, counted by RTP headers: frames that are whole, packets lost, late and sent again.

Headers are taken in the order of their sequence numbers. A missing packet is waited for, as a browser's jitter buffer does, until
GIVE_UP_S have passed; then the frame that it belonged to is incomplete, and what follows cannot be decoded until a keyframe comes.
"""

from __future__ import annotations

import time
from collections import Counter

GIVE_UP_S = 1.0
RTP_CLOCK_HZ = 90_000
LONG_GAP_FRAMES = 3
SENDER_REPORTS = 20         # that are kept
_JITTER_SHARE = 1 / 16      # RFC 3550, 6.4.1


class RtpCount:
    """Counters of one viewer. `delays_ms` has the whole milliseconds from a frame's RTP time to its completion, how often each, and
    `sender_reports_ms` what the newest sender reports say that a frame's time is behind its RTP time; RTP time 0 is taken to be
    `epoch` (seconds of `time.time()`)."""

    def __init__(self, epoch: float, fps: float) -> None:
        self.packets = self.lost = self.late = self.retransmitted = 0
        self.frames = self.keyframes = self.incomplete = self.undecodable = self.gaps = 0
        self.bytes = 0
        self.delays_ms: Counter[int] = Counter()
        self.first_keyframe_at: float | None = None     # time.monotonic()
        self.longest_gap_s = 0.0
        self.jitter_ticks = 0.0
        self.sender_reports_ms: list[float] = []
        self.needs_keyframe = True
        self.timestamp: int | None = None               # of the newest frame that has begun to arrive
        self._epoch, self._long_gap_s = epoch, LONG_GAP_FRAMES / fps
        self._first = self._next = self._highest = -1   # sequence numbers that do not wrap
        self._waiting: dict[int, tuple[bool, int, bool]] = {}
        self._missing: dict[int, float] = {}            # since when
        self._frame: int | None = None                  # timestamp of the one that is being put together
        self._whole = self._is_keyframe = False
        self._hole = False
        self._last_frame_at: float | None = None
        self._last_transit: float | None = None

    @property
    def highest(self) -> int:
        """The highest sequence number received, counted on beyond 16 bits."""
        return self._highest

    @property
    def expected(self) -> int:
        """Packets that were sent as far as is known."""
        return self._highest - self._first + 1 if self._first >= 0 else 0

    def payload_matters(self, sequence: int, timestamp: int) -> bool:
        """Whether the packet may begin a frame, so that its payload tells if that is a keyframe."""
        return timestamp != self.timestamp or (sequence - self._highest) & 0xFFFF != 1

    def packet(self, sequence: int, timestamp: int, *, marker: bool, keyframe: bool) -> bool:
        """Take one header; `keyframe` says that a keyframe begins in this packet. Returns whether packets before it are missing
        that were not yet."""
        self.packets += 1
        if self._first < 0:
            self._first = self._next = sequence
            self._highest = sequence - 1
        number = self._highest + ((sequence - self._highest + 0x8000) & 0xFFFF) - 0x8000
        if number == self._next and not self._waiting:
            self._highest = self._next = number
            self._next += 1
            self.timestamp = timestamp
            self._in_order(timestamp, marker, keyframe)
            return False
        return self._out_of_order(number, timestamp, marker, keyframe)

    def sender_report(self, wall: float, timestamp: int) -> None:
        """RTCP says that this RTP time is this time of the sender's clock (seconds of `time.time()`)."""
        self.sender_reports_ms.append(1e3 * (wall - self._epoch - timestamp / RTP_CLOCK_HZ))
        del self.sender_reports_ms[:-SENDER_REPORTS]

    def missing(self) -> list[int]:
        """Sequence numbers, as RTP has them, to ask for again."""
        return [number & 0xFFFF for number in self._missing]

    def give_up(self, now: float) -> bool:
        """Go on without what has been missing for too long. Returns whether there was any, so that a keyframe is needed."""
        gave_up = False
        while self._missing and now - next(iter(self._missing.values())) > GIVE_UP_S:
            upto = min(self._waiting)
            for number in range(self._next, upto):
                self._missing.pop(number, None)
            self.lost += upto - self._next
            self._next, self._hole = upto, True
            gave_up = self.needs_keyframe = True
            self._drain()
        return gave_up

    def _out_of_order(self, number: int, timestamp: int, marker: bool, keyframe: bool) -> bool:
        if number < self._next or number in self._waiting:
            self.late += 1
            return False
        self._waiting[number] = (marker, timestamp, keyframe)
        self._missing.pop(number, None)
        new = range(max(self._highest + 1, self._next), number)
        if new:
            now = time.monotonic()
            self._missing.update(dict.fromkeys(new, now))
        if number > self._highest:
            self._highest, self.timestamp = number, timestamp
        self._drain()
        return bool(new)

    def _drain(self) -> None:
        while self._next in self._waiting:
            marker, timestamp, keyframe = self._waiting.pop(self._next)
            self._next += 1
            self._in_order(timestamp, marker, keyframe)

    def _in_order(self, timestamp: int, marker: bool, keyframe: bool) -> None:
        if timestamp != self._frame:
            self.incomplete += self._frame is not None
            self._frame, self._whole, self._is_keyframe = timestamp, True, False
        if self._hole:
            self._whole, self._hole = False, False
        self._is_keyframe |= keyframe
        if marker:
            self._frame = None
            if self._whole:
                self._complete(timestamp)
            else:
                self.incomplete += 1
                self.needs_keyframe = True

    def _complete(self, timestamp: int) -> None:
        if self.needs_keyframe and not self._is_keyframe:
            self.undecodable += 1
            return
        now, wall = time.monotonic(), time.time()
        self.needs_keyframe = False
        self.frames += 1
        self.keyframes += self._is_keyframe
        if self.first_keyframe_at is None:
            self.first_keyframe_at = now
        transit = wall - self._epoch - timestamp / RTP_CLOCK_HZ
        self.delays_ms[int(transit * 1e3)] += 1
        if self._last_frame_at is not None and self._last_transit is not None:
            gap = now - self._last_frame_at
            self.gaps += gap > self._long_gap_s
            self.longest_gap_s = max(self.longest_gap_s, gap)
            self.jitter_ticks += (abs(transit - self._last_transit) * RTP_CLOCK_HZ - self.jitter_ticks) * _JITTER_SHARE
        self._last_frame_at, self._last_transit = now, transit

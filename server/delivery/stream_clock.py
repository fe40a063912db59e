"""Ticks of a stream's tracks as wall-clock time, so that RTCP sender reports let a receiver put sound and picture together.

A report with the time of sending, as aiortc makes it, will not do: picture and sound take differently long to get there. The clock
of the stream says when they were *captured*: both tracks count from the same instant.
"""

from __future__ import annotations

import time

VIDEO_CLOCK_HZ = 90_000      # of every video codec over RTP
NTP_EPOCH_S = 2_208_988_800     # 1900-01-01 to 1970-01-01


class StreamClock:
    """Fixed by the first frame of the stream, then never moved."""

    def __init__(self) -> None:
        self._origin: float | None = None

    def start(self, ticks: int, rate: int, captured_at: float) -> None:
        """Ticks of a frame that was captured at that `time.monotonic()`. Only the first call counts."""
        if self._origin is None:
            self._origin = time.time() - time.monotonic() + captured_at - ticks / rate

    def ntp(self, ticks: int, rate: int) -> int:
        """NTP timestamp, 32.32 bits, of a tick of a track with that clock rate in Hz."""
        seconds = (self._origin or 0.0) + ticks / rate + NTP_EPOCH_S
        return round(seconds * (1 << 32))

"""Source timestamps onto one monotonic output clock, because sources restart, wrap and jump."""

from __future__ import annotations

CLOCK_RATE = 90_000
MAX_DRIFT_S = 0.5       # beyond this from the arrival time, source timestamps are taken to have jumped
MIN_STEP = 90           # ticks between two frames: 1 ms


class OutputClock:
    """RTP-like ticks, strictly increasing. Follows the source's own spacing while it is plausible, arrival times otherwise."""

    def __init__(self, first_timestamp: int) -> None:
        self._first = first_timestamp
        self._last = first_timestamp - MIN_STEP
        self._start: float | None = None
        self._offset: float | None = None   # source seconds to seconds since start
        self.discontinuities = 0

    def timestamp(self, pts: float | None, arrived_at: float) -> int:
        """Ticks for a frame with that source time (seconds, or None) that arrived at that monotonic time."""
        if self._start is None:
            self._start = arrived_at
        arrival = arrived_at - self._start
        seconds = arrival
        if pts is not None:
            if self._offset is None or abs(pts + self._offset - arrival) > MAX_DRIFT_S:
                self.discontinuities += self._offset is not None
                self._offset = arrival - pts
            seconds = pts + self._offset
        ticks = self._first + round(seconds * CLOCK_RATE)
        self._last = max(ticks, self._last + MIN_STEP)
        return self._last

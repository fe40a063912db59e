"""Bits per second of something that comes in pieces, over the last two seconds."""

from __future__ import annotations

from collections import deque

WINDOW_S = 2.0
SHORTEST_S = 0.5        # before that the figure would be of one keyframe


class ByteRate:
    def __init__(self) -> None:
        self._pieces: deque[tuple[float, int]] = deque()
        self._bytes = 0
        self.total = 0

    def add(self, count: int, now: float) -> None:
        self._pieces.append((now, count))
        self._bytes += count
        self.total += count
        while self._pieces[0][0] < now - WINDOW_S:
            self._bytes -= self._pieces.popleft()[1]

    def bps(self, now: float) -> float | None:
        """None when too little has come lately to tell."""
        if not self._pieces or now - self._pieces[-1][0] > WINDOW_S:
            return None
        span = now - self._pieces[0][0]
        return 8 * self._bytes / span if span >= SHORTEST_S else None

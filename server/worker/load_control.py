"""What is given up while frames are being dropped: first, how often the light is read from the frame."""

from __future__ import annotations

import time
from collections.abc import Callable

INTERVALS = (1, 2, 4)    # frames from one reading of the light to the next
PATIENCE_S = 1.0         # of dropping at one interval, before the next longer one is tried
RECOVERY_S = 5.0         # without a drop, before the next shorter one is tried again
LONGEST_RECOVERY_S = 80.0


class LoadControl:
    """Reads the light in every frame, or less often while frames are dropped.

    Each time a shorter interval proves too much, the next attempt at it waits twice as long, so that it does not oscillate.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._level = 0
        self._dropped: int | None = None
        self._changed_at = self._last_drop = clock()
        self._eased = False
        self._recovery_s = RECOVERY_S

    @property
    def environment_interval(self) -> int:
        return INTERVALS[self._level]

    def reuse_light(self, frame: int, dropped: int) -> bool:
        """Whether this frame takes the last one's light; `dropped` counts all frames dropped so far."""
        now = self._clock()
        fell_behind = self._dropped is not None and dropped > self._dropped
        self._dropped = dropped
        if fell_behind:
            self._last_drop = now
            if self._level < len(INTERVALS) - 1 and (self._level == 0 or now - self._changed_at > PATIENCE_S):
                self._recovery_s = min(2 * self._recovery_s, LONGEST_RECOVERY_S) if self._eased else RECOVERY_S
                self._level, self._changed_at, self._eased = self._level + 1, now, False
        elif self._level and now - max(self._last_drop, self._changed_at) > self._recovery_s:
            self._level, self._changed_at, self._eased = self._level - 1, now, True
        return frame % self.environment_interval != 0

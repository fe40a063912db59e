"""What is given up while frames are being dropped: first, how often the light is read from the frame."""

from __future__ import annotations

import time
from collections.abc import Callable

RECOVERY_S = 5.0      # without a drop, before full accuracy is tried again
LONGEST_RECOVERY_S = 80.0


class LoadControl:
    """Reads the light in every frame, or in every second one after frames were dropped.

    Each time full accuracy proves too much at once, the next attempt waits twice as long, so that it does not oscillate.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self.environment_interval = 1
        self._dropped: int | None = None
        self._changed_at = self._last_drop = clock()
        self._recovery_s = RECOVERY_S

    def reuse_light(self, frame: int, dropped: int) -> bool:
        """Whether this frame takes the last one's light; `dropped` counts all frames dropped so far."""
        now = self._clock()
        fell_behind = self._dropped is not None and dropped > self._dropped
        self._dropped = dropped
        if fell_behind:
            self._last_drop = now
            if self.environment_interval == 1:
                relapse = now - self._changed_at < self._recovery_s
                self._recovery_s = min(2 * self._recovery_s, LONGEST_RECOVERY_S) if relapse else RECOVERY_S
                self.environment_interval, self._changed_at = 2, now
        elif self.environment_interval == 2 and now - max(self._last_drop, self._changed_at) > self._recovery_s:
            self.environment_interval, self._changed_at = 1, now
        return frame % self.environment_interval != 0

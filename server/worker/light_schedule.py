"""When there is time for the light of a live frame: after the frame has gone to the encoder, for the frames that follow.

Reading it takes as long as compositing, and a thirtieth of a second is nothing to the light. So the picture goes first. The
light is read while the encoder works, in steps, each of them when it can be done before the next frame is due; and where there is
never enough time, one step is taken every few frames all the same.
"""

from __future__ import annotations

import time
from collections.abc import Callable

READ, PREPARE, FINISH = "read", "prepare", "finish"    # find the light; filter it for the surfaces in use and cast its shadows;
# shade by it the objects whose turn it is
LONGEST_WAIT = 3        # frames that a step waits for time
SMOOTHING = 0.1


class LightSchedule:
    """Asked once for each step that is wanted after a frame. Times are seconds of the `clock`."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._waited = 0            # frames that a step has been put off
        self._cost_s: dict[str, float] = {}     # of each step, smoothed

    def has_time(self, step: str, due_at: float) -> bool:
        """Whether to take this step before the next frame comes, which is due at that time."""
        if self._waited + 1 >= LONGEST_WAIT or self._clock() + self.cost_s(step) <= due_at:
            return True
        self._waited += 1
        return False

    def took(self, step: str, seconds: float) -> None:
        """The step has been taken, in that time."""
        before = self._cost_s.get(step, seconds)
        self._cost_s[step] = before + SMOOTHING * (seconds - before)
        self._waited = 0

    def cost_s(self, step: str) -> float:
        """What the step takes, 0 before it has been taken."""
        return self._cost_s.get(step, 0.0)

"""When the light of a live frame is read: after the frame has gone to the encoder, for the frames that follow.

Reading it takes as long as compositing, and a thirtieth of a second is nothing to the light. So the picture goes first. The
light is read while the encoder works, in two steps, each of them when it can be done before the next frame is due. Two
exceptions: after a cut the old light would be seen for a frame, so the new one is read first; and where there is never
enough time, one step is taken every few frames all the same.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from renderer.frame import YuvFrame

READ, PREPARE = "read", "prepare"    # the steps: find the light; filter it for the surfaces in use and cast its shadows
LONGEST_WAIT = 3        # frames from one step to the next
CUT_CODES = 12.0        # mean difference of luma, between frames with and without a cut
SMOOTHING = 0.1
SAMPLE_STEP = 32        # pixels; 2,048 samples of a frame of 2048 x 1024


class LightSchedule:
    """Asked once before and, for each step, once after compositing a frame. Times are seconds of the `clock`."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._seen: NDArray[np.int16] | None = None
        self._waited = 0            # frames since the last step
        self._frames = self._readings = 0
        self._cost_s: dict[str, float] = {}     # of each step, smoothed

    def is_cut(self, picture: YuvFrame) -> bool:
        """Whether this frame has little to do with the last one, or is the first: then its light must be read first."""
        samples = picture.y[SAMPLE_STEP // 2::SAMPLE_STEP, ::SAMPLE_STEP].astype(np.int16)
        seen, self._seen = self._seen, samples
        self._frames += 1
        self._waited += 1
        is_cut = seen is None or float(np.abs(samples - seen).mean()) > CUT_CODES
        self._readings += is_cut
        return is_cut

    def has_time(self, step: str, due_at: float) -> bool:
        """Whether to take this step before the next frame comes, which is due at that time."""
        return self._waited >= LONGEST_WAIT or self._clock() + self._cost_s.get(step, 0.0) <= due_at

    def took(self, step: str, seconds: float) -> None:
        """The step has been taken, in that time."""
        before = self._cost_s.get(step, seconds)
        self._cost_s[step] = before + SMOOTHING * (seconds - before)
        self._waited = 0
        self._readings += step == READ

    @property
    def mean_interval(self) -> float:
        """Frames a reading, over all frames so far."""
        return self._frames / max(self._readings, 1)

"""Pieces of sound with times of their own, laid end to end into blocks that follow each other without a gap."""

from __future__ import annotations

import statistics
from collections import deque

import numpy as np
from numpy.typing import NDArray

from server.worker.output_clock import SOUND_RATE

BLOCK = SOUND_RATE // 50                # 20 ms
LONGEST_SILENCE = SOUND_RATE // 2       # longer gaps are not filled: the time stamps jump
AT_ONCE = SOUND_RATE // 25              # 40 ms: more than this beside the clock is put right at once,
IN_TIME = SOUND_RATE // 100             # more than 10 ms when the median of so many pieces is: time stamps are rounded, and jitter
PIECES = 15

Samples = NDArray[np.int16]


class SoundTimeline:
    """Times are ticks of the samples' own rate. Samples are counted; their given times only correct the count."""

    def __init__(self) -> None:
        self._blocks: list[tuple[int, Samples]] = []
        self._pending: Samples = np.zeros((0, 2), np.int16)
        self._end: int | None = None        # of what has been laid
        self._beside: deque[int] = deque(maxlen=PIECES)

    def lay(self, samples: Samples, tick: int) -> list[tuple[int, Samples]]:
        """Blocks of BLOCK samples that are now complete, each with the tick of its first one. What overlaps is dropped."""
        if self._end is None or tick - self._end > LONGEST_SILENCE:
            self._begin(tick)
        correction = self._correction(tick)
        if correction > 0:
            self._append(np.zeros((correction, 2), np.int16))
        self._append(samples[max(-correction, 0):])
        blocks, self._blocks = self._blocks, []
        return blocks

    def _begin(self, tick: int) -> None:
        if len(self._pending):      # its last block ends in silence
            self._append(np.zeros((BLOCK - len(self._pending), 2), np.int16))
        self._end = tick
        self._beside.clear()

    def _correction(self, tick: int) -> int:
        """Samples of silence to insert, or to drop if negative."""
        assert self._end is not None
        self._beside.append(tick - self._end)
        usual = round(statistics.median(self._beside))
        if abs(self._beside[-1]) > AT_ONCE:
            correction = self._beside[-1]
        elif len(self._beside) == PIECES and abs(usual) > IN_TIME:
            correction = usual
        else:
            return 0
        self._beside.clear()
        return correction

    def _append(self, samples: Samples) -> None:
        assert self._end is not None
        start = self._end - len(self._pending)
        self._end += len(samples)
        self._pending = np.concatenate((self._pending, samples))
        while len(self._pending) >= BLOCK:
            self._blocks.append((start, self._pending[:BLOCK]))
            self._pending = self._pending[BLOCK:]
            start += BLOCK

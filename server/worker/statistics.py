"""Rolling figures of the worker, as its `stats` message reports them."""

from __future__ import annotations

import threading
import time
from collections import deque
from typing import Any

import numpy as np

WINDOW = 300


class RollingStatistics:
    """Render and stage times of the last `WINDOW` frames, and the rate of rendered frames over the last two seconds.

    Written by the main thread, read by the heartbeat.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._render: deque[float] = deque(maxlen=WINDOW)
        self._stages: dict[str, deque[float]] = {}
        self._moments: deque[float] = deque(maxlen=WINDOW)
        self.touched_fraction = 0.0

    def add(self, render_ms: float, stages_ms: dict[str, float]) -> None:
        with self._lock:
            self._render.append(render_ms)
            self._moments.append(time.monotonic())
            for name, value in stages_ms.items():
                self._stages.setdefault(name, deque(maxlen=WINDOW)).append(value)

    def fps(self) -> float:
        now = time.monotonic()
        with self._lock:
            recent = [moment for moment in self._moments if now - moment <= 2.0]
        if len(recent) < 2 or now - recent[-1] > 1.0:
            return 0.0
        return round((len(recent) - 1) / max(recent[-1] - recent[0], 1e-3), 2)

    def render_ms(self) -> dict[str, float] | None:
        with self._lock:
            return percentiles(self._render)

    def stages_ms(self) -> dict[str, dict[str, float]]:
        with self._lock:
            return {name: figures for name, values in self._stages.items() if (figures := percentiles(values)) is not None}


class TrackStatistics:
    """What one encoder has made, and its times for the last `WINDOW` frames. Written by its thread, read by the heartbeat."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._encode: deque[float] = deque(maxlen=WINDOW)
        self.frames_encoded = self._bytes = self._keyframes = 0

    def add(self, encode_ms: float, size: int, *, is_keyframe: bool) -> None:
        with self._lock:
            self._encode.append(encode_ms)
            self.frames_encoded += 1
            self._bytes += size
            self._keyframes += is_keyframe

    def report(self) -> dict[str, Any]:
        with self._lock:
            return {"frames_encoded": self.frames_encoded, "bytes": self._bytes, "keyframes": self._keyframes,
                    "encode_ms": percentiles(self._encode)}


def percentiles(values: deque[float] | list[float]) -> dict[str, float] | None:
    """p50, p95 and max, rounded; None without values."""
    if not values:
        return None
    p50, p95 = np.percentile(list(values), [50, 95])
    return {"p50": round(float(p50), 3), "p95": round(float(p95), 3), "max": round(float(max(values)), 3)}

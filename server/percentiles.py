"""p50, p95 and maximum of the newest values."""

from __future__ import annotations

from collections import deque

WINDOW = 300      # frames, as the worker reports its own


class Percentiles:
    """A ring of the newest values. Cheap to add to, sorted only when asked."""

    def __init__(self, window: int = WINDOW) -> None:
        self._values: deque[float] = deque(maxlen=window)

    def add(self, value: float) -> None:
        self._values.append(value)

    def summary(self) -> dict[str, float] | None:
        """`{"p50", "p95", "max"}` by nearest rank, or None as long as there is no value."""
        if not self._values:
            return None
        ordered = sorted(self._values)
        return {"p50": _nearest_rank(ordered, 0.50), "p95": _nearest_rank(ordered, 0.95), "max": ordered[-1]}


def _nearest_rank(ordered: list[float], fraction: float) -> float:
    return ordered[min(len(ordered) - 1, int(fraction * len(ordered)))]

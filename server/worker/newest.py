"""A mailbox between threads: what is new wins, what is late is lost and counted (as scrcpy's frame buffer)."""

from __future__ import annotations

import threading
import time
from collections import deque
from typing import Generic, TypeVar

T = TypeVar("T")
SLOTS = 2


class Newest(Generic[T]):
    """Thread-safe. The producer never waits; the consumer waits for a value, a `wake` or a timeout.

    A value is lost when a newer one comes, unless it has waited for less than `patience_s`: of two that come in one burst
    (after a keyframe that took long to decode) both are delivered.
    """

    def __init__(self, patience_s: float = 0.0) -> None:
        self._patience_s = patience_s
        self._condition = threading.Condition()
        self._values: deque[tuple[float, T]] = deque()
        self._woken = False
        self.dropped = 0

    def put(self, value: T) -> None:
        with self._condition:
            now = time.monotonic()
            while self._values and (len(self._values) == SLOTS or now - self._values[0][0] >= self._patience_s):
                self._lose()
            self._values.append((now, value))
            self._condition.notify()

    def take(self, timeout: float) -> T | None:
        """The oldest value that is not late, or None after `timeout` seconds or a `wake`."""
        with self._condition:
            self._condition.wait_for(lambda: self._values or self._woken, timeout)
            self._woken = False
            while len(self._values) > 1 and time.monotonic() - self._values[0][0] >= self._patience_s:
                self._lose()
            return self._values.popleft()[1] if self._values else None

    def _lose(self) -> None:
        self._values.popleft()
        self.dropped += 1

    def wake(self) -> None:
        with self._condition:
            self._woken = True
            self._condition.notify()

"""A one-slot mailbox: the newest value wins, what it replaces is lost and counted (as scrcpy's frame buffer)."""

from __future__ import annotations

import threading
from typing import Generic, TypeVar

T = TypeVar("T")


class Newest(Generic[T]):
    """Thread-safe. The producer never waits; the consumer waits for a value, a `wake` or a timeout."""

    def __init__(self) -> None:
        self._condition = threading.Condition()
        self._value: T | None = None
        self._woken = False
        self.dropped = 0

    def put(self, value: T) -> None:
        with self._condition:
            if self._value is not None:
                self.dropped += 1
            self._value = value
            self._condition.notify()

    def take(self, timeout: float) -> T | None:
        """The newest value, or None after `timeout` seconds or a `wake`."""
        with self._condition:
            self._condition.wait_for(lambda: self._value is not None or self._woken, timeout)
            value, self._value, self._woken = self._value, None, False
            return value

    def wake(self) -> None:
        with self._condition:
            self._woken = True
            self._condition.notify()

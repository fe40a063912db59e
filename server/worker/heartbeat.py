"""Statistics twice a second for as long as the main thread makes progress; without them the server replaces the worker."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from server.worker.named_thread import NamedThread

HEARTBEAT_S = 0.5


class Heartbeat:
    """`beat` is called from a thread of its own."""

    def __init__(self, beat: Callable[[], None]) -> None:
        self._beat = beat
        self._alive_until = 0.0
        self._closed = threading.Event()
        self._thread = NamedThread(target=self._run, name="heartbeat", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def allow(self, seconds: float) -> None:
        """The main thread may be busy for this long before the server takes it for dead."""
        self._alive_until = max(self._alive_until, time.monotonic() + seconds)

    def _run(self) -> None:
        while not self._closed.wait(HEARTBEAT_S):
            if time.monotonic() < self._alive_until:
                self._beat()

    def close(self) -> None:
        self._closed.set()
        if self._thread.is_alive():
            self._thread.join(1.0)

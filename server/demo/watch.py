"""Waiting for child processes, and for what they say, until a signal comes."""

from __future__ import annotations

import contextlib
import json
import signal
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

from server.demo.children import Child, Children

SAMPLE_EVERY_S = 0.2


class DemoError(RuntimeError):
    """The run cannot go on; the text says why."""


class StopError(Exception):
    """A signal came."""


class Watch:
    """Waiting that ends with StopError at a signal and with ChildError when a child has ended."""

    def __init__(self, children: Children, stop: threading.Event) -> None:
        self._children, self._stop = children, stop

    def pause(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            if self._stop.wait(min(left, 0.5)):
                raise StopError
            self._children.check()

    def until(self, what: str, check: Callable[[], bool], seconds: float) -> None:
        """Raises DemoError when `check` has not come true in that time."""
        end = time.monotonic() + seconds
        while not check():
            if time.monotonic() > end:
                raise DemoError(f"no {what} within {seconds:g} s")
            self.pause(SAMPLE_EVERY_S)


class NewestLine:
    """`value` is the newest JSON object that a piped child has written; empty before the first."""

    def __init__(self, child: Child) -> None:
        self.value: dict[str, Any] = {}
        self._child = child
        threading.Thread(target=self._read, name=f"lines of the {child.name}", daemon=True).start()

    def _read(self) -> None:
        for line in self._child.stdout:
            self.value = json.loads(line)
        self._child.stdout.close()


@contextlib.contextmanager
def signals_set(stop: threading.Event) -> Iterator[None]:
    """SIGINT and SIGTERM set the event instead of ending this process."""
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(number, lambda *_: stop.set()) for number in numbers]
    try:
        yield
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)

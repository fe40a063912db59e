"""Answers requests for a picture: encodes it beside the main thread."""

from __future__ import annotations

import threading
from collections.abc import Callable

from renderer.frame import YuvFrame
from server.worker.messages import Message
from server.worker.named_thread import NamedThread
from server.worker.picture import encode_jpeg


class Snapshots:
    """`send` is thread-safe. `close` waits for the last answers."""

    def __init__(self, send: Callable[[Message, bytes], None]) -> None:
        self._send = send
        self._threads: list[threading.Thread] = []

    def answer(self, request: int, picture: YuvFrame | None) -> None:
        """None: there is no picture yet."""
        if picture is None:
            self._send({"type": "snapshot", "request": request, "error": "no frame has come from the source yet"}, b"")
            return
        self._threads = [thread for thread in self._threads if thread.is_alive()]
        thread = NamedThread(target=self._encode, args=(request, picture), name="snapshot", daemon=True)
        self._threads.append(thread)
        thread.start()

    def _encode(self, request: int, picture: YuvFrame) -> None:
        try:
            self._send({"type": "snapshot", "request": request, "error": None}, encode_jpeg(picture))
        except Exception as error:
            self._send({"type": "snapshot", "request": request, "error": f"snapshot failed: {error}"}, b"")

    def close(self) -> None:
        for thread in self._threads:
            thread.join(1.0)

"""An output process's end of the socket pair, and the pulse by which the server knows that it makes progress."""

from __future__ import annotations

import contextlib
import os
import socket
import threading
import time
from collections.abc import Iterator

from server.worker.messages import Message, encode_message, receive_message

PULSE_S = 0.5
STUCK_AFTER_S = 5.0         # in one write: the peer takes nothing any more


class OutputFailedError(RuntimeError):
    """The output cannot go on. `hopeless`: trying again soon will hardly help; `at_once`: the next try will work."""

    def __init__(self, reason: str, *, hopeless: bool = False, at_once: bool = False, retry_after_s: float | None = None) -> None:
        super().__init__(reason)
        self.hopeless = hopeless
        self.at_once = at_once
        self.retry_after_s = retry_after_s


def failed_message(error: OutputFailedError) -> Message:
    return {"type": "failed", "reason": str(error), "hopeless": error.hopeless, "at_once": error.at_once,
            "retry_after_s": error.retry_after_s}


class ServerLink:
    """Blocking receive by one thread, sending by any."""

    def __init__(self, connection: socket.socket) -> None:
        self._socket = connection
        self._lock = threading.Lock()

    def receive(self) -> tuple[Message, bytes]:
        """Raises EOFError when the server has gone."""
        try:
            return receive_message(self._socket)
        except OSError as error:
            raise EOFError(str(error)) from None

    def send(self, message: Message) -> None:
        with self._lock, contextlib.suppress(OSError):      # the reader is told of the end
            self._socket.sendall(encode_message(message))


class Pulse:
    """Counts what has gone out and reports it every `PULSE_S`, from a thread of its own.

    The report is also the heartbeat: it stays away while a call of FFmpeg's holds the interpreter. A call that lets others run
    and does not come back is ended from here, because nothing else can.
    """

    def __init__(self, link: ServerLink) -> None:
        self.frames = 0
        self.bytes = 0
        self._link = link
        self._writing_since: float | None = None
        threading.Thread(target=self._beat, name="pulse", daemon=True).start()

    @contextlib.contextmanager
    def writing(self) -> Iterator[None]:
        self._writing_since = time.monotonic()
        try:
            yield
        finally:
            self._writing_since = None

    def report(self) -> None:
        self._link.send({"type": "progress", "frames": self.frames, "bytes": self.bytes})

    def _beat(self) -> None:
        while True:
            time.sleep(PULSE_S)
            since = self._writing_since
            if since is not None and time.monotonic() - since > STUCK_AFTER_S:
                self._link.send(failed_message(OutputFailedError(f"nothing could be written for {STUCK_AFTER_S:g} s")))
                os._exit(1)
            self.report()

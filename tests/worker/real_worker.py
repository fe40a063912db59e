"""A worker process of its own, driven over its socket as the server does."""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import av
import numpy as np

from server.worker.messages import encode_message, receive_message

LIMIT_S = 60.0


class RealWorker:
    """`python -m server.worker` on a source, with the given tracks in demand."""

    def __init__(self, source: str | Path, tracks: Iterable[str] = ("full/h264",)) -> None:
        self._socket, theirs = socket.socketpair()
        self._socket.settimeout(LIMIT_S)
        self._process = subprocess.Popen([sys.executable, "-m", "server.worker", "--fd", str(theirs.fileno())],
                                         pass_fds=[theirs.fileno()])
        theirs.close()
        self.send({"type": "start", "stream": "live", "source": str(source), "allow_files": True, "scene": {}, "revision": 0})
        self.demand(*tracks)
        self._decoder = av.CodecContext.create("h264", "r")

    @property
    def pid(self) -> int:
        return self._process.pid

    def send(self, message: dict[str, Any]) -> None:
        self._socket.sendall(encode_message(message))

    def demand(self, *tracks: str) -> None:
        self.send({"type": "demand", "tracks": tracks, "lights": 0})

    def messages(self) -> Iterator[tuple[dict[str, Any], bytes]]:
        """As they come, for at most LIMIT_S."""
        deadline = time.monotonic() + LIMIT_S
        while time.monotonic() < deadline:
            yield receive_message(self._socket)

    def pictures(self) -> Iterator[tuple[int, np.ndarray[Any, np.dtype[np.uint8]]]]:
        """Frame numbers and (height, width, 3) pictures as they come."""
        for message, payload in self.messages():
            if message["type"] == "packet":
                for frame in self._decoder.decode(av.Packet(payload)):
                    yield int(message["frame"]), frame.to_ndarray(format="rgb24")

    def light_methods(self) -> Iterator[str]:
        """The method of each light message as it comes."""
        for message, _ in self.messages():
            if message["type"] == "lights":
                yield str(message["message"]["method"])

    def stop(self) -> None:
        self.send({"type": "stop"})
        assert self._process.wait(LIMIT_S) == 0
        self._socket.close()

"""What the server is told about the source and what is made of it, on every change."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

from av.video.frame import VideoFrame

from server.worker.messages import Message
from server.worker.picture import picture_flags
from server.worker.source import SourceInfo


class StateReport:
    """Called from several threads; `send` is thread-safe."""

    def __init__(self, send: Callable[[Message, bytes], None]) -> None:
        self._send = send
        self._lock = threading.Lock()
        self._state: dict[str, Any] = {"source": "idle", "detail": None, "input": None, "output": None, "flags": []}
        self._picture_flags: list[str] = []
        self._no_sound = False

    def source(self, source: str, detail: str | None, info: SourceInfo | None = None) -> None:
        """`idle`, `connecting`, `live` or `lost`, why, and what it brings if it is known."""
        with self._lock:
            if source == "connecting" and self._state["source"] == "lost":
                return      # still lost, as a person sees it, until a frame comes
            changes: dict[str, Any] = {"source": source, "detail": detail}
            if info is not None:
                self._no_sound = info.no_sound
                known = asdict(info)
                del known["no_sound"]
                changes["input"] = known
            self._change(changes)

    def picture(self, frame: VideoFrame, output: tuple[int, int]) -> None:
        """A frame has come, to be processed at that size."""
        geometry = {"width": frame.width, "height": frame.height, "pix_fmt": frame.format.name}
        flags = picture_flags(frame.width, frame.height, output, frame.format.name)
        with self._lock:
            self._picture_flags = flags
            self._change({"input": {**(self._state["input"] or {}), **geometry}})

    def output(self, size: tuple[int, int], renditions: list[dict[str, Any]]) -> None:
        """What is made of the pictures, and at which bitrates."""
        full = next((rung["bitrate_bps"] for rung in renditions if (rung["width"], rung["height"]) == size), None)
        with self._lock:
            self._change({"output": {"width": size[0], "height": size[1], "bitrate_bps": full, "renditions": renditions}})

    def _change(self, changes: dict[str, Any]) -> None:
        flags = [*self._picture_flags, *["no_sound"] * self._no_sound]
        state = {**self._state, **changes, "flags": flags}
        if state != self._state:
            self._state = state
            self._send({"type": "state", **state}, b"")

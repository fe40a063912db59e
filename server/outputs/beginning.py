"""When an output's first picture goes out."""

from __future__ import annotations

import time
from collections.abc import Callable

SOUND_LIMIT_S = 2.0         # the worker begins to encode sound when somebody wants it


class Beginning:
    """The first picture is a keyframe that was taken after the connection stood and the sound had come.

    What has queued up while the connection came about would be late for ever after, and arrive in a burst. Pictures without the
    sound that the header promises would be held back by the muxer, and receivers that keep time by arrival would take that as the
    picture's pace.
    """

    def __init__(self, request_keyframe: Callable[[], None], *, sound: bool) -> None:
        self._request_keyframe = request_keyframe
        self._sound_missing = sound
        self._opened_at: float | None = None
        self._since: float | None = None

    def opened(self) -> None:
        self._opened_at = time.monotonic()
        self._look()

    def sound_came(self) -> None:
        self._sound_missing = False
        self._look()

    def reached_by(self, decoded_at: float, *, keyframe: bool) -> bool:
        """Whether a picture taken at that `time.monotonic()` may be the first."""
        self._look()
        return self._since is not None and keyframe and decoded_at >= self._since

    def _look(self) -> None:
        if self._since is not None or self._opened_at is None:
            return
        now = time.monotonic()
        if not self._sound_missing or now - self._opened_at > SOUND_LIMIT_S:
            self._since = now
            self._request_keyframe()

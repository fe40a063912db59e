"""A stream's light messages to whoever follows them. A slow follower gets the newest, never a backlog."""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import Callable, Iterator
from typing import Any

from server.newest import Newest

FRAME_WAIT_S = 2.0


class LightFeed:
    """`len` of it is the number of followers; `followers_changed` is called when that is another."""

    def __init__(self, followers_changed: Callable[[], None]) -> None:
        self.newest: dict[str, Any] | None = None
        self._followers: set[Newest[str]] = set()
        self._followers_changed = followers_changed

    def __len__(self) -> int:
        return len(self._followers)

    @contextlib.contextmanager
    def subscription(self) -> Iterator[Newest[str]]:
        """A mailbox with the newest light message as JSON text. As long as it is held, frames are rendered."""
        mailbox: Newest[str] = Newest()
        self._followers.add(mailbox)
        self._followers_changed()
        try:
            yield mailbox
        finally:
            self._followers.discard(mailbox)
            self._followers_changed()

    async def of_a_frame_now(self) -> dict[str, Any] | None:
        """The light message of a frame processed now, or the last one there was if none comes."""
        with self.subscription() as mailbox, contextlib.suppress(TimeoutError):
            async with asyncio.timeout(FRAME_WAIT_S):
                await mailbox.get()
        return self.newest

    def take(self, lights: dict[str, Any]) -> None:
        """The worker's message."""
        self.newest = dict(lights)
        if self._followers:
            text = json.dumps(lights, allow_nan=False, separators=(",", ":"))
            for mailbox in self._followers:
                mailbox.put(text)

"""What a client of the events WebSocket has yet to be told.

At most one event per subject: a newer one takes the place of the older, so the outbox stays small however slow the
client reads, and the client still ends at the present state.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

Event = dict[str, Any]
MAX_EVENTS = 300


class EventOutbox:
    """Filled by the stream, emptied by one client's sender."""

    def __init__(self, scene_event: Callable[[], Event]) -> None:
        self._scene_event = scene_event
        self._events: dict[tuple[str, str], Event] = {}
        self._filled = asyncio.Event()

    def put(self, event: Event) -> None:
        """The subject of an event is its type and, for an object or an error, the `id` it has."""
        if event["type"] == "scene":
            self._events = {subject: other for subject, other in self._events.items() if subject[0] != "object"}
        subject = (event["type"], str(event.get("id", "")))
        self._events.pop(subject, None)     # so that the newer one also takes its place in the order
        self._events[subject] = event
        if len(self._events) > MAX_EVENTS:
            self._events = {("scene", ""): self._scene_event()}
        self._filled.set()

    async def get(self) -> Event:
        while not self._events:
            self._filled.clear()
            await self._filled.wait()
        return self._events.pop(next(iter(self._events)))

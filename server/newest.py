"""Hand-over of a stream of values to one slow reader: it gets the newest, never a backlog."""

from __future__ import annotations

import asyncio
from typing import Generic, TypeVar

T = TypeVar("T")


class Newest(Generic[T]):
    """A mailbox with one slot. `put` never waits; `get` has one caller at a time."""

    def __init__(self) -> None:
        self._value: T | None = None
        self._filled = asyncio.Event()

    def put(self, value: T) -> None:
        self._value = value
        self._filled.set()

    async def get(self) -> T:
        await self._filled.wait()
        self._filled.clear()
        value, self._value = self._value, None
        assert value is not None
        return value

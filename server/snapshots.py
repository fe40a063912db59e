"""Pictures of a stream on request: everybody who asks while one is being made gets that one."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from server.worker.messages import Message

SNAPSHOT_WAIT_S = 3.0


class SnapshotError(RuntimeError):
    """There is no picture, the text says why."""


class Snapshots:
    """`send` hands a request to the worker."""

    def __init__(self, send: Callable[[Message], None]) -> None:
        self._send = send
        self._waiting: asyncio.Future[bytes] | None = None
        self._request = 0

    async def newest(self) -> bytes:
        """The newest composite as JPEG. Raises SnapshotError."""
        if self._waiting is None:
            self._waiting = asyncio.get_running_loop().create_future()
            self._request += 1
            self._send({"type": "snapshot", "request": self._request})
        try:
            async with asyncio.timeout(SNAPSHOT_WAIT_S):
                return await asyncio.shield(self._waiting)
        except TimeoutError:
            raise SnapshotError("the worker gave no picture in time") from None
        finally:
            self._waiting = None

    def take(self, message: Message, picture: bytes) -> None:
        """The worker's answer. Raises KeyError for one that is wrong."""
        if message["request"] != self._request or self._waiting is None or self._waiting.done():
            return
        if message["error"] is None:
            self._waiting.set_result(picture)
        else:
            self.fail(str(message["error"]))

    def fail(self, reason: str) -> None:
        """Nothing will come any more."""
        if self._waiting is not None and not self._waiting.done():
            self._waiting.set_exception(SnapshotError(reason))
            self._waiting.exception()       # retrieved here, in case nobody waits any more

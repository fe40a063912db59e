"""The operating-system process of one output, seen from the server."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from server.worker.messages import Message, encode_message
from server.worker_process import WorkerProcess

OUTPUT_COMMAND: tuple[str, ...] = (sys.executable, "-m", "server.outputs")
SILENCE_LIMIT_S = 10.0      # FFmpeg holds the interpreter while it connects


class OutputProcess(WorkerProcess):
    """Started, watched and stopped like a worker. Packets go to it in order, at the speed at which it takes them."""

    @classmethod
    def _command(cls) -> Sequence[str]:
        return OUTPUT_COMMAND

    @property
    def _silence_limit_s(self) -> float:
        return SILENCE_LIMIT_S

    @property
    def fell_silent(self) -> bool:
        return self._silent_s >= SILENCE_LIMIT_S

    async def write(self, message: Message, payload: bytes = b"") -> None:
        """Returns when there is room for more. Raises ConnectionError when the process has gone."""
        self._writer.write(encode_message(message, payload))
        await self._writer.drain()

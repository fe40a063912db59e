"""The operating-system process of one worker: start, messages both ways, watch, stop.

Nothing here waits for the worker: outgoing messages lie in one slot per type (a newer one replaces it; keyframe
requests in one per track), a worker that falls silent is killed, and one that does not end when asked is killed too.
The processes of outputs are like it, with a command and limits of their own (`server/outputs/process.py`).
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import signal
import socket
import sys
from collections.abc import Callable, Sequence
from typing import Self

from server.worker.messages import Message, ProtocolError, encode_message, read_message

logger = logging.getLogger(__name__)

WORKER_COMMAND: tuple[str, ...] = (sys.executable, "-m", "server.worker")
STARTUP_LIMIT_S = 30.0
SILENCE_LIMIT_S = 2.0
STOP_LIMIT_S = 1.0
REAP_LIMIT_S = 5.0          # a killed process can still sit in the kernel, in a driver
WATCH_INTERVAL_S = 0.1
READ_BUFFER_BYTES = 4 << 20

Receive = Callable[[Message, bytes], None]


class WorkerProcess:
    """A started worker. `run` it until it ends, then `stop` it, whatever the reason."""

    def __init__(self, process: asyncio.subprocess.Process, reader: asyncio.StreamReader,
                 writer: asyncio.StreamWriter) -> None:
        self._process = process
        self._reader = reader
        self._writer = writer
        self._outgoing: dict[str, Message] = {}
        self._has_outgoing = asyncio.Event()
        self._silent_s = 0.0
        self._ready = False

    @classmethod
    async def start(cls, start: Message) -> Self:
        """Start the process; `start` will be its first message.

        Raises:
            OSError: the process cannot be started.
        """
        ours, theirs = socket.socketpair()
        try:
            with theirs:
                # A session of its own: Ctrl-C in the terminal reaches the server only, which ends its workers in order.
                process = await asyncio.create_subprocess_exec(
                    *cls._command(), "--fd", str(theirs.fileno()), pass_fds=(theirs.fileno(),),
                    stdin=asyncio.subprocess.DEVNULL, start_new_session=True)
        except BaseException:
            ours.close()
            raise
        try:
            ours.setblocking(False)
            reader, writer = await asyncio.open_unix_connection(sock=ours, limit=READ_BUFFER_BYTES)
        except BaseException:
            process.kill()
            ours.close()
            raise
        worker = cls(process, reader, writer)
        worker.send(start)
        return worker

    @classmethod
    def _command(cls) -> Sequence[str]:
        return WORKER_COMMAND

    @property
    def _silence_limit_s(self) -> float:
        return SILENCE_LIMIT_S if self._ready else STARTUP_LIMIT_S

    @property
    def pid(self) -> int:
        return self._process.pid

    def send(self, message: Message, slot: str | None = None) -> None:
        """Send, at the latest when the worker reads again; until then a newer message of the slot (by default: of the type) takes
        its place."""
        self._outgoing[slot or message["type"]] = message
        self._has_outgoing.set()

    async def run(self, receive: Receive) -> str:
        """Hand every message to `receive` until the worker ends or falls silent. Returns the reason, never raises for
        anything the worker does; `receive` may raise ValueError, KeyError or TypeError for a message that is wrong."""
        tasks = [asyncio.create_task(step) for step in (self._read(receive), self._write(), self._watch())]
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            # The writer may notice the end first, but only the reader knows what came before it.
            await asyncio.wait(tasks[:1], timeout=0.2)
            ended = next(task for task in tasks if task.done())
            return ended.result()
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def stop(self) -> None:
        """End the process within `STOP_LIMIT_S`, by force if need be. Idempotent."""
        if self._process.returncode is None and self._silent_s < SILENCE_LIMIT_S:
            with contextlib.suppress(OSError, TimeoutError):
                async with asyncio.timeout(STOP_LIMIT_S):
                    self._writer.write(encode_message({"type": "stop"}))
                    await self._process.wait()
        if self._process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                self._process.kill()
            try:
                async with asyncio.timeout(REAP_LIMIT_S):
                    await self._process.wait()
            except TimeoutError:
                logger.error("worker %d does not end although it was killed", self.pid)
        self._writer.transport.abort()      # what is still unsent has no reader any more

    async def _read(self, receive: Receive) -> str:
        try:
            while True:
                message, payload = await read_message(self._reader)
                self._silent_s = 0.0
                self._ready = self._ready or message["type"] == "ready"
                receive(message, payload)
        except (asyncio.IncompleteReadError, ConnectionError):
            return await self._exit_reason()
        except (ProtocolError, ValueError, KeyError, TypeError, OverflowError) as error:
            return f"sent a message that is wrong: {error!r}"

    async def _exit_reason(self) -> str:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(STOP_LIMIT_S):
                await self._process.wait()
        status = self._process.returncode
        if status is None:
            return "closed its connection"
        if status < 0:
            with contextlib.suppress(ValueError):
                return f"was ended by {signal.Signals(-status).name}"
        return f"exited with status {status}"

    async def _write(self) -> str:
        try:
            while True:
                await self._has_outgoing.wait()
                self._has_outgoing.clear()
                while self._outgoing:
                    message = self._outgoing.pop(next(iter(self._outgoing)))
                    self._writer.write(encode_message(message))
                    await self._writer.drain()
        except OSError as error:
            return f"does not read: {error}"

    async def _watch(self) -> str:
        """Counts its own ticks instead of reading a clock, so that a stall of this process is not held against the
        worker."""
        while True:
            await asyncio.sleep(WATCH_INTERVAL_S)
            self._silent_s += WATCH_INTERVAL_S
            if self._silent_s >= self._silence_limit_s:
                return f"was silent for {self._silence_limit_s:g} s"

"""Keeps one stream's worker running: starts it, replaces it when it dies or hangs, ever more slowly if that goes on."""

from __future__ import annotations

import asyncio
import logging
import time
from typing import Protocol

from server.worker.messages import Message
from server.worker_process import WorkerProcess

logger = logging.getLogger(__name__)

BACKOFF_S = (0.5, 5.0)          # first and longest pause before a worker is replaced
FATAL_RETRY_S = 30.0            # what a worker calls fatal (no GL) will hardly come right by itself
HEALTHY_S = 10.0                # a worker that ran this long makes the backoff begin anew
FAILED_STARTS = 3               # so many in a row that never got ready, and the stream has failed


class Supervised(Protocol):
    """What the supervisor asks of the stream and tells it."""

    name: str

    def start_message(self) -> Message: ...

    def worker_started(self) -> None: ...

    def worker_ready(self) -> None: ...

    def worker_ended(self, reason: str, *, failed: bool) -> None: ...

    def receive(self, message: Message, payload: bytes) -> None: ...


class Supervisor:
    """`run` it as a task; cancelling that ends the worker."""

    def __init__(self, stream: Supervised) -> None:
        self.restarts = 0
        self.renderer: str | None = None    # GL_RENDERER
        self.startup_s = 0.0                # of the last worker that got ready; the next one will take about as long
        self._stream = stream
        self._worker: WorkerProcess | None = None
        self._got_ready = False
        self._started_at = 0.0
        self._fatal: str | None = None

    @property
    def ready(self) -> bool:
        """The worker has its GL, and no reason to replace it has been seen."""
        return self._got_ready and self._worker is not None

    def send(self, message: Message, slot: str | None = None) -> None:
        """Send to the worker if there is one: a new one is told everything at its start."""
        if self._worker is not None:
            self._worker.send(message, slot)

    async def run(self) -> None:
        pause, failed_starts = BACKOFF_S[0], 0
        while True:
            reason = await self._run_worker()
            if self._got_ready and time.monotonic() - self._started_at >= HEALTHY_S:
                pause = BACKOFF_S[0]
            failed_starts = 0 if self._got_ready else failed_starts + 1
            self._tell_end(reason, failed=failed_starts >= FAILED_STARTS)
            await asyncio.sleep(FATAL_RETRY_S if self._fatal else pause)
            pause = min(2 * pause, BACKOFF_S[1])
            self.restarts += 1

    async def _run_worker(self) -> str:
        worker: WorkerProcess | None = None
        self._started_at, self._fatal, self._got_ready = time.monotonic(), None, False
        try:
            self._worker = worker = await WorkerProcess.start(self._stream.start_message())
            logger.info("%s: worker %d started", self._stream.name, worker.pid)
            self._stream.worker_started()
            return await worker.run(self._receive)
        except OSError as error:
            return f"could not be started: {error}"
        finally:
            self._worker = None
            if worker is not None:
                await asyncio.shield(worker.stop())

    def _receive(self, message: Message, payload: bytes) -> None:
        match message["type"]:
            case "ready":
                self.renderer = str(message["renderer"])
                self._got_ready, self.startup_s = True, time.monotonic() - self._started_at
                logger.info("%s: worker ready in %.1f s, GL renderer %s, OpenGL %s", self._stream.name, self.startup_s,
                            self.renderer, message["gl_version"])
                self._stream.worker_ready()
            case "fatal":
                self._fatal = str(message["error"])
            case _:
                self._stream.receive(message, payload)

    def _tell_end(self, reason: str, *, failed: bool) -> None:
        if self._fatal is not None:
            logger.error("%s: %s", self._stream.name, self._fatal)
            self._stream.worker_ended(self._fatal, failed=True)
        else:
            logger.warning("%s: the worker %s, it is replaced", self._stream.name, reason)
            self._stream.worker_ended(f"the worker {reason}, it is replaced", failed=failed)

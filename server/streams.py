"""All streams of the service."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Iterator
from dataclasses import dataclass

from server.config import Settings
from server.metrics import Metrics, StreamMetrics
from server.stream import Stream, StreamSettings

logger = logging.getLogger(__name__)

LIVE = "live"       # the stream that always exists


class DuplicateStreamError(ValueError):
    """The name is in use."""


class TooManyStreamsError(RuntimeError):
    """`max_streams` is reached."""


@dataclass(frozen=True, slots=True)
class _Running:
    stream: Stream
    task: asyncio.Task[None]


class Streams:
    """Owner of the streams and of the tasks that keep their workers running."""

    def __init__(self, settings: Settings, metrics: Metrics) -> None:
        self._settings = settings
        self._metrics = metrics
        self._running: dict[str, _Running] = {}

    def __iter__(self) -> Iterator[Stream]:
        return iter([running.stream for running in self._running.values()])

    def __len__(self) -> int:
        return len(self._running)

    def find(self, name: str) -> Stream | None:
        running = self._running.get(name)
        return running.stream if running else None

    def add(self, name: str, source: str | None) -> Stream:
        """Create the stream and start its worker. Raises DuplicateStreamError, TooManyStreamsError."""
        if name in self._running:
            raise DuplicateStreamError(name)
        if len(self._running) >= self._settings.max_streams:
            raise TooManyStreamsError(name)
        stream_settings = StreamSettings(
            str(self._settings.assets_dir), self._settings.require_gpu, self._settings.bitrate_bps, self._settings.renditions,
            recordings_dir=str(self._settings.recordings_dir), max_outputs=self._settings.max_outputs)
        stream = Stream(name, source, stream_settings, StreamMetrics(self._metrics, name))
        task = asyncio.create_task(stream.run(), name=f"stream {name}")
        task.add_done_callback(_log_crash)
        self._running[name] = _Running(stream, task)
        for configured in self._settings.outputs:
            if configured.stream == name:
                stream.outputs.add(configured.spec)
        return stream

    async def remove(self, name: str) -> None:
        running = self._running.pop(name)
        await _end(running)
        self._metrics.forget(name)

    async def close(self) -> None:
        running, self._running = list(self._running.values()), {}
        await asyncio.gather(*(_end(item) for item in running))


async def _end(running: _Running) -> None:
    running.task.cancel()
    await asyncio.gather(asyncio.wait([running.task]), running.stream.outputs.close())


def _log_crash(task: asyncio.Task[None]) -> None:
    if not task.cancelled() and (error := task.exception()) is not None:
        logger.critical("%s ended by an error of its own", task.get_name(), exc_info=error)

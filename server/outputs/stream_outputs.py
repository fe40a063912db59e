"""All ways out of one stream."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from typing import Any

from server.outputs.output import Output, OutputStream
from server.outputs.spec import OutputSpec, PlaybackEntry


class DuplicateOutputError(ValueError):
    """The id is in use."""


class TooManyOutputsError(RuntimeError):
    """`max_outputs` is reached."""


class StreamOutputs:
    """Owner of a stream's outputs and their processes. `changed` is called when one is added, removed, or in another state."""

    def __init__(self, stream: OutputStream, *, limit: int, recordings_dir: str, changed: Callable[[], None]) -> None:
        self._stream = stream
        self._limit = limit
        self._recordings_dir = recordings_dir
        self._changed = changed
        self._outputs: dict[str, Output] = {}
        self._source: tuple[str, str | None, dict[str, Any] | None] | None = None

    def __iter__(self) -> Iterator[Output]:
        return iter(self._outputs.values())

    def find(self, output_id: str) -> Output | None:
        return self._outputs.get(output_id)

    def add(self, spec: OutputSpec, networks: tuple[str, ...] | None = None) -> Output:
        """Create and start it. `networks`, outside the public internet, are where it may connect to; None: anywhere.

        Raises DuplicateOutputError, TooManyOutputsError.
        """
        if spec.id in self._outputs:
            raise DuplicateOutputError(spec.id)
        if len(self._outputs) >= self._limit:
            raise TooManyOutputsError(f"{self._limit} outputs exist, the setting max_outputs")
        output = Output(spec, self._stream, recordings_dir=self._recordings_dir, networks=networks, changed=self._changed)
        self._outputs[spec.id] = output
        if self._source is not None:
            output.source_changed(*self._source)
        output.start()
        self._changed()
        return output

    async def remove(self, output_id: str) -> None:
        await self._outputs.pop(output_id).stop()
        self._changed()

    async def close(self) -> None:
        """End all processes."""
        await asyncio.gather(*(output.stop() for output in self._outputs.values()))

    def source_changed(self, state: str, detail: str | None, source: dict[str, Any] | None) -> None:
        self._source = (state, detail, source)
        for output in self._outputs.values():
            output.source_changed(state, detail, source)

    def status(self) -> list[dict[str, Any]]:
        return [output.status() for output in self._outputs.values()]

    def playback(self) -> Iterator[tuple[str, PlaybackEntry, str]]:
        """Where people watch what is live out there: the output's id, the entry, the rendition."""
        for output in self._outputs.values():
            if output.live:
                for entry in output.spec.playback:
                    yield output.spec.id, entry, entry.rendition or output.rendition

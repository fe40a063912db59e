"""One way out of a stream: keeps a process running that pushes or records, and feeds it from the stream's fan-outs."""

from __future__ import annotations

import asyncio
import logging
import random
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Protocol

from server.delivery.fanout import EncodedFrame
from server.delivery.tracks import Tracks, video_track
from server.outputs.process import SILENCE_LIMIT_S, OutputProcess
from server.outputs.spec import OutputSpec
from server.renditions import AUDIO
from server.worker.messages import Message

logger = logging.getLogger(__name__)

BACKOFF_S = (0.5, 10.0)         # first and longest pause before the next try
JITTER = 0.25                   # so that what was lost together does not come back together
HOPELESS_RETRY_S = 30.0
HEALTHY_S = 10.0                # what was live this long makes the backoff begin anew


class OutputStream(Protocol):
    """What an output asks of its stream."""

    name: str
    tracks: Tracks

    @property
    def rendition_names(self) -> Sequence[str]:
        """Best first."""
        ...

    def scene_of(self, revision: int) -> dict[str, Any] | None:
        """The scene as JSON; None when it is long gone."""
        ...


@dataclass(frozen=True, slots=True)
class _Ended:
    reason: str
    hopeless: bool = False
    at_once: bool = False
    retry_after_s: float | None = None


class Output:
    """`start` it; `stop` ends its process. `changed` is called when what `description` says of its state is another."""

    def __init__(self, spec: OutputSpec, stream: OutputStream, *, recordings_dir: str, networks: tuple[str, ...] | None,
                 changed: Callable[[], None]) -> None:
        self.spec = spec
        self.state = "disabled"
        self.detail: str | None = None
        self.since = datetime.now(UTC)
        self.restarts = 0
        self._stream = stream
        self._recordings_dir = recordings_dir
        self.networks = networks
        self._changed = changed
        self._task: asyncio.Task[None] | None = None
        self._changing = asyncio.Lock()             # of the task
        self._stopped = False
        self._sound: bool | None = None             # None: nothing is known of the source yet
        self._sound_known = asyncio.Event()
        self._process: OutputProcess | None = None
        self._ready = asyncio.Event()
        self._ended: _Ended | None = None
        self._live_at: float | None = None
        self._counted = {"frames": 0, "bytes": 0}   # by the processes before this one
        self._counts = {"frames": 0, "bytes": 0}    # by this one

    @property
    def rendition(self) -> str:
        """The one that goes out."""
        return self.spec.rendition or self._stream.rendition_names[0]

    @property
    def live(self) -> bool:
        return self.state == "live"

    @property
    def frames(self) -> int:
        """Pictures sent or written since the output was made."""
        return self._counted["frames"] + self._counts["frames"]

    @property
    def bytes_out(self) -> int:
        """Of packets sent or written since the output was made, without the overhead of container and network."""
        return self._counted["bytes"] + self._counts["bytes"]

    def description(self) -> dict[str, Any]:
        """The resource, without its secrets."""
        spec = self.spec
        where = {"prefix": spec.prefix} if spec.kind == "record" else {"url": spec.shown_url}
        return {
            "id": spec.id, "kind": spec.kind, **where, "rendition": self.rendition, "token_set": spec.token is not None,
            "playback": [entry.model_dump(exclude_none=True) for entry in spec.playback], "enabled": spec.enabled, **self.status(),
        }

    def status(self) -> dict[str, Any]:
        """What of the resource changes by itself."""
        return {"id": self.spec.id, "state": self.state, "detail": self.detail,
                "since": self.since.isoformat(timespec="milliseconds"), "frames": self.frames, "bytes": self.bytes_out,
                "restarts": self.restarts}

    def start(self) -> None:
        if self.spec.enabled:
            self._set("connecting", None if self._sound_known.is_set() else "the stream has no source yet")
            self._task = asyncio.create_task(self._run(), name=f"output {self.spec.id} of {self._stream.name}")
            self._task.add_done_callback(_log_crash)

    async def stop(self) -> None:
        """For good."""
        self._stopped = True
        async with self._changing:
            await self._end_task()

    async def _end_task(self) -> None:
        task, self._task = self._task, None
        if task is not None:
            task.cancel()
            await asyncio.wait([task])

    async def replace(self, spec: OutputSpec, networks: tuple[str, ...] | None) -> None:
        """Go on as that. Only what does not reach the process is changed without a new one."""
        async with self._changing:
            same = spec.model_copy(update={"playback": self.spec.playback}) == self.spec
            self.spec, self.networks = spec, networks
            if not same:
                await self._end_task()
                self._set("disabled", None)
                if not self._stopped:
                    self.start()

    def source_changed(self, state: str, detail: str | None, source: dict[str, Any] | None) -> None:
        """Told of the stream's source: its state, and what it carries (None while nothing is known)."""
        if source is not None:
            self._sound = source.get("audio") is not None
            self._sound_known.set()
        if self.state == "connecting" and source is not None:
            self._set("connecting", None)
        if self._process is not None and self.spec.kind == "record":
            self._process.send({"type": "source", "state": state, "detail": detail})

    # --- the life of the process -----------------------------------------------------------------------------------

    async def _run(self) -> None:
        pause = BACKOFF_S[0]
        while True:
            await self._sound_known.wait()
            ended = await self._try()
            if self._live_at is not None and time.monotonic() - self._live_at >= HEALTHY_S:
                pause = BACKOFF_S[0]
            self._set("failed-config" if ended.hopeless else "retrying", self.spec.conceal(ended.reason))
            wait_s = ended.retry_after_s or (HOPELESS_RETRY_S if ended.hopeless else BACKOFF_S[0] if ended.at_once else pause)
            await asyncio.sleep(wait_s * random.uniform(1 - JITTER, 1 + JITTER))
            if not ended.at_once:
                pause = min(2 * pause, BACKOFF_S[1])
            self.restarts += 1

    async def _try(self) -> _Ended:
        """One process, from its start to its end."""
        self._ended, self._live_at = None, None
        self._ready.clear()
        sound = bool(self._sound)
        try:
            self._process = process = await OutputProcess.start(self._start_message(sound))
        except OSError as error:
            return _Ended(f"the output's process could not be started: {error}")
        running = asyncio.create_task(process.run(self._receive))
        feeding = [asyncio.create_task(self._feed_pictures(process, sound))]
        if sound:
            feeding.append(asyncio.create_task(self._feed_sound(process)))
        try:
            await asyncio.wait([running, *feeding], return_when=asyncio.FIRST_COMPLETED)
            if self._ended is None:     # what feeds may notice the end first, but only the process says why
                await asyncio.wait([running], timeout=1.0)
            return self._ended or _Ended(self._reason(process, running.result() if running.done() else "does not read"))
        finally:
            self._process = None
            for task in (running, *feeding):
                task.cancel()
            await asyncio.gather(running, *feeding, return_exceptions=True)
            await asyncio.shield(process.stop())
            self._counted, self._counts = {"frames": self.frames, "bytes": self.bytes_out}, {"frames": 0, "bytes": 0}

    def _reason(self, process: OutputProcess, ending: str) -> str:
        if process.fell_silent and self._ready.is_set() and self._live_at is None and self.spec.url is not None:
            return f"no answer within {SILENCE_LIMIT_S:g} s"     # FFmpeg connects without letting others run
        return f"the output's process {ending}"

    def _start_message(self, sound: bool) -> Message:
        spec = self.spec
        return {"type": "start", "stream": self._stream.name, "kind": spec.kind, "url": spec.url, "token": spec.token,
                "prefix": spec.prefix, "folder": self._recordings_dir, "networks": self.networks, "sound": sound}

    def _receive(self, message: Message, payload: bytes) -> None:
        match message["type"]:
            case "ready":
                self._ready.set()
            case "live":
                self._live_at = time.monotonic()
                self._set("live", message["detail"])
            case "progress":
                self._counts = {"frames": int(message["frames"]), "bytes": int(message["bytes"])}
            case "keyframe":
                self._stream.tracks.fanout(self._track).request_keyframe()
            case "failed":
                wait_s = message["retry_after_s"]
                self._ended = _Ended(str(message["reason"]), hopeless=bool(message["hopeless"]), at_once=bool(message["at_once"]),
                                     retry_after_s=None if wait_s is None else float(wait_s))
            case unknown:
                raise ValueError(f"message type is {unknown!r}, expected one of ARCHITECTURE.md")

    # --- what goes to the process ----------------------------------------------------------------------------------

    @property
    def _track(self) -> str:
        return video_track(self.rendition, "h264")

    async def _feed_pictures(self, process: OutputProcess, sound: bool) -> None:
        """Until the process ends, or needs another header because the sound has come or gone."""
        await self._ready.wait()
        told_revision = -1
        fanout = self._stream.tracks.fanout(self._track)
        taker = fanout.join()
        try:
            while True:
                frame = await taker.next_frame()
                if bool(self._sound) != sound:
                    self._ended = _Ended(f"the source's sound has {'gone' if sound else 'come'}", at_once=True)
                    return
                if self.spec.kind == "record" and frame.scene_revision != told_revision:
                    told_revision = frame.scene_revision
                    await process.write({"type": "scene", "revision": told_revision, "scene": self._stream.scene_of(told_revision)})
                await process.write(_picture(frame), frame.data)
        except ConnectionError:
            return
        finally:
            fanout.leave(taker)

    async def _feed_sound(self, process: OutputProcess) -> None:
        await self._ready.wait()
        fanout = self._stream.tracks.fanout(AUDIO)
        taker = fanout.join()
        try:
            while True:
                frame = await taker.next_frame()
                await process.write({"type": "sound", "timestamp": frame.timestamp}, frame.data)
        except ConnectionError:
            return
        finally:
            fanout.leave(taker)

    def _set(self, state: str, detail: str | None) -> None:
        if (state, detail) == (self.state, self.detail):
            return
        if state != self.state:
            self.since = datetime.now(UTC)
        self.state, self.detail = state, detail
        logger.info("%s: output %s %s%s", self._stream.name, self.spec.id, state, f", {detail}" if detail else "")
        self._changed()


def _picture(frame: EncodedFrame) -> Message:
    return {"type": "picture", "timestamp": frame.timestamp, "keyframe": frame.keyframe, "revision": frame.scene_revision,
            "decoded_at": frame.decoded_at}


def _log_crash(task: asyncio.Task[None]) -> None:
    if not task.cancelled() and (error := task.exception()) is not None:
        logger.critical("%s ended by an error of its own", task.get_name(), exc_info=error)

"""One stream: its scene, its worker under supervision, its viewers and subscribers."""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from server.delivery.fanout import EncodedFrame
from server.delivery.stream_clock import VIDEO_CLOCK_HZ
from server.delivery.tracks import Tracks, video_track
from server.event_outbox import Event, EventOutbox
from server.light_feed import LightFeed
from server.live_scene import LiveScene
from server.metrics import StreamMetrics
from server.outputs.stream_outputs import StreamOutputs
from server.percentiles import Percentiles
from server.renditions import AUDIO, CODECS, LADDER, Rendition
from server.snapshots import Snapshots
from server.source_url import is_file_source, masked
from server.supervisor import Supervisor
from server.worker.messages import Message

logger = logging.getLogger(__name__)



@dataclass(frozen=True, slots=True)
class StreamSettings:
    """What of the service's settings a stream passes on to its worker."""

    assets_dir: str
    require_gpu: bool
    bitrate_bps: int | None
    renditions: tuple[Rendition, ...] = LADDER
    recordings_dir: str = "recordings"
    max_outputs: int = 8


class Stream:
    """Owner of everything that belongs to one stream. `run` it as a task; cancelling that ends the worker."""

    def __init__(self, name: str, source: str | None, settings: StreamSettings, metrics: StreamMetrics) -> None:
        self.name = name
        self.source = source
        self.state = "idle" if source is None else "connecting"
        self.detail: str | None = None
        self.input: dict[str, Any] | None = None
        self.output: dict[str, Any] | None = None
        self.flags: list[str] = []
        self.lights = LightFeed(self._send_demand)
        self.worker_stats: dict[str, Any] = {}
        self.latency_ms = Percentiles()
        self.live_scene = LiveScene(self._scene_changed)
        self.tracks = Tracks(request_keyframe=self._request_keyframe, demand_changed=self._demand_changed,
                             set_bitrate=self._set_bitrate)
        self._settings = settings
        self._metrics = metrics
        self._events: set[EventOutbox] = set()
        self._newest_timestamp = 0                  # in ticks of 1 / 90000 s since the stream began
        self._viewers_told = 0
        self._timestamp_at = 0.0
        self.outputs = StreamOutputs(self, limit=settings.max_outputs, recordings_dir=settings.recordings_dir,
                                     changed=lambda: self._publish(self._outputs_event()))
        self._supervisor = Supervisor(self)
        self._snapshots = Snapshots(self._supervisor.send)

    # --- what others see -------------------------------------------------------------------------------------------

    @property
    def ready(self) -> bool:
        """The worker has its GL and is not silent."""
        return self._supervisor.ready

    @property
    def rendition_names(self) -> list[str]:
        """Of the ladder, best first."""
        return [rendition.name for rendition in self._settings.renditions]

    @property
    def restarts(self) -> int:
        return self._supervisor.restarts

    def scene_of(self, revision: int) -> dict[str, Any] | None:
        """The scene as JSON that a picture of that revision shows; None when it is long gone."""
        scene = self.live_scene.at(revision)
        return None if scene is None else scene.model_dump(mode="json")

    def description(self) -> dict[str, Any]:
        """The resource `/api/streams/{stream}`."""
        return {
            "name": self.name,
            "source": None if self.source is None else masked(self.source),
            "state": self.state, "detail": self.detail,
            "input": self.input, "output": self.output, "flags": self.flags,
            "viewers": self.tracks.viewers,
            "worker": {"ready": self.ready, "restarts": self.restarts, "renderer": self._supervisor.renderer},
        }

    def stats(self) -> dict[str, Any]:
        return {
            **self.worker_stats,
            "viewers": self.tracks.viewers,
            "packets_delivered": self.tracks.delivered,
            "dropped_after_encoder": self.tracks.dropped,
            "latency_ms": self.latency_ms.summary(),
            "worker_restarts": self.restarts,
            "outputs": self.outputs.status(),
        }

    def delivered(self, seconds: float) -> None:
        """A viewer's packet has been handed to WebRTC, so long after its source frame was decoded."""
        self.latency_ms.add(seconds * 1000.0)
        self._metrics.latency_seconds.observe(seconds)

    # --- what others ask for ---------------------------------------------------------------------------------------

    def set_source(self, source: str | None) -> None:
        self.source = source
        self._set_state("idle" if source is None else "connecting", None)
        self._supervisor.send({"type": "source", "source": source})

    @contextlib.contextmanager
    def event_subscription(self) -> Iterator[EventOutbox]:
        """An outbox that begins with the whole present state."""
        outbox = EventOutbox(self._scene_event)
        for event in (self._scene_event(), self._source_event(), self._outputs_event(), self._viewers_event()):
            outbox.put(event)
        self._events.add(outbox)
        try:
            yield outbox
        finally:
            self._events.discard(outbox)

    async def snapshot(self) -> bytes:
        """The newest composite as JPEG. Raises SnapshotError."""
        if not self.tracks.wanted and not len(self.lights):
            await self.lights.of_a_frame_now()      # nothing is being rendered: have one frame made for this
        return await self._snapshots.newest()

    # --- the worker's life, told by the supervisor -----------------------------------------------------------------

    async def run(self) -> None:
        """Keep a worker running until cancelled."""
        await self._supervisor.run()

    def start_message(self) -> Message:
        elapsed_s = time.monotonic() - self._timestamp_at + self._supervisor.startup_s
        first = self._newest_timestamp + round(elapsed_s * VIDEO_CLOCK_HZ) if self._newest_timestamp else 0
        return {
            "type": "start", "stream": self.name, "source": self.source,
            "allow_files": is_file_source(self.source), "require_gpu": self._settings.require_gpu,
            "assets": self._settings.assets_dir, "bitrate_bps": self._settings.bitrate_bps,
            "scene": self.live_scene.as_json(), "revision": self.live_scene.revision,
            "renditions": [rendition.model_dump() for rendition in self._settings.renditions],
            "timestamp": first,
        }

    def worker_started(self) -> None:
        self._send_demand()
        for track, bps in self.tracks.squeezed().items():
            self._set_bitrate(track, bps)
        self.tracks.encoders_replaced()

    def worker_ready(self) -> None:
        if self.state == "failed":
            self._set_state("idle" if self.source is None else "connecting", None)

    def worker_ended(self, reason: str, *, failed: bool) -> None:
        self._metrics.worker_ended()
        self.worker_stats = {}
        self._snapshots.fail(reason)
        if failed:
            self._set_state("failed", reason)
        elif self.source is not None:
            self._set_state("lost", reason)

    # --- from the worker -------------------------------------------------------------------------------------------

    def receive(self, message: Message, payload: bytes) -> None:
        """Take what the worker sent. Raises KeyError, TypeError or ValueError for what it must not send."""
        match message["type"]:
            case "packet":
                self._receive_packet(message, payload)
            case "lights":
                self.lights.take(message["message"])
            case "stats":
                self.worker_stats = {key: value for key, value in message.items() if key != "type"}
                self._metrics.worker_stats(self.worker_stats)
            case "state":
                self.input, self.output = message["input"], message["output"]
                self.flags = [str(flag) for flag in message["flags"]]
                self._note_bitrates()
                self._set_state(str(message["source"]), message["detail"])
            case "snapshot":
                self._snapshots.take(message, payload)
            case unknown:
                raise ValueError(f"message type is {unknown!r}, expected one of ARCHITECTURE.md")

    def _receive_packet(self, message: Message, payload: bytes) -> None:
        track, timestamp = str(message["track"]), int(message["timestamp"])
        if track != AUDIO:
            self._newest_timestamp, self._timestamp_at = timestamp, time.monotonic()
            self._metrics.render_seconds.observe(float(message["render_ms"]) / 1000.0)
        self.tracks.publish(track, EncodedFrame(payload, timestamp, keyframe=bool(message["keyframe"]),
                                                decoded_at=float(message["decoded_at"]),
                                                scene_revision=int(message.get("revision", 0))))

    def _note_bitrates(self) -> None:
        for rung in (self.output or {}).get("renditions", ()):
            for codec in CODECS:
                self.tracks.nominal_bps[video_track(rung["name"], codec)] = float(rung["bitrate_bps"])

    # --- to the worker ---------------------------------------------------------------------------------------------

    def _send_demand(self) -> None:
        self._supervisor.send({"type": "demand", "tracks": self.tracks.wanted, "lights": len(self.lights)})

    def _request_keyframe(self, track: str) -> None:
        self._supervisor.send({"type": "keyframe", "track": track}, slot=f"keyframe {track}")

    def _set_bitrate(self, track: str, bps: int | None) -> None:
        self._supervisor.send({"type": "bitrate", "track": track, "bps": bps}, slot=f"bitrate {track}")

    # --- changes ---------------------------------------------------------------------------------------------------

    def _demand_changed(self) -> None:
        self._send_demand()
        if self.tracks.viewers != self._viewers_told:
            self._viewers_told = self.tracks.viewers
            self._publish(self._viewers_event())

    def _scene_changed(self, live: LiveScene, changed_id: str | None) -> None:
        self._supervisor.send({"type": "scene", "scene": live.as_json(), "revision": live.revision})
        if not self._events:
            return
        if changed_id is None:
            self._publish(self._scene_event())
        else:
            placed = live.find(changed_id)
            self._publish({"type": "object", "id": changed_id, "revision": live.revision,
                           "object": placed.model_dump(mode="json") if placed else None})

    def _set_state(self, state: str, detail: str | None) -> None:
        if detail is not None:
            detail = masked(str(detail))
        if (state, detail) != (self.state, self.detail):
            logger.info("%s: source %s%s", self.name, state, f", {detail}" if detail else "")
        self.state, self.detail = state, detail
        self.outputs.source_changed(state, detail, self.input)
        self._publish(self._source_event())

    def _publish(self, event: Event) -> None:
        for outbox in self._events:
            outbox.put(event)

    def _scene_event(self) -> Event:
        return {"type": "scene", "revision": self.live_scene.revision, "scene": self.live_scene.as_json()}

    def _source_event(self) -> Event:
        return {"type": "source", "state": self.state, "detail": self.detail, "input": self.input,
                "output": self.output, "flags": self.flags}

    def _outputs_event(self) -> Event:
        return {"type": "outputs", "outputs": self.outputs.status()}

    def _viewers_event(self) -> Event:
        return {"type": "viewers", "count": self.tracks.viewers}

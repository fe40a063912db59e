"""The worker's main thread: takes the newest frame, renders it, sends what it found, hands the picture to the encoder."""

from __future__ import annotations

import logging
import resource
import time
from collections.abc import Callable
from pathlib import Path
from queue import Empty, SimpleQueue

from renderer.frame import YuvFrame
from renderer.gl import Context
from renderer.light.reading import FrameLight
from renderer.scene import Scene
from server.renditions import AUDIO, LADDER, Rendition
from server.worker.compositor import Compositor
from server.worker.encode import Composited
from server.worker.encoders import Encoders
from server.worker.frame_budget import FrameBudget
from server.worker.heartbeat import Heartbeat
from server.worker.ingest import Ingest
from server.worker.light_message import light_message
from server.worker.messages import Message
from server.worker.newest import Newest
from server.worker.output_clock import OutputClock
from server.worker.picture import PictureError, output_size
from server.worker.snapshots import Snapshots
from server.worker.sound import Sound
from server.worker.source import Decoded, SourceInfo
from server.worker.state_report import StateReport
from server.worker.statistics import RollingStatistics

logger = logging.getLogger(__name__)
STEP_ALLOWANCE_S = 1.5    # the main thread counts as alive for this long after each step of its loop,
SCENE_ALLOWANCE_S = 6.0   # for this long after a new scene, whose models it may have to load,
OPEN_ALLOWANCE_S = 25.0   # and for this long while the driver compiles the shaders of a new geometry or other methods
BURST_S = 0.04            # of two frames that come within this time, both are rendered
REPEAT_AFTER_S = 0.4      # without a new frame, the last one is rendered again so that edits of the scene are seen
REPEAT_INTERVAL_S = 0.1
Send = Callable[[Message, bytes], None]


class RenderLoop:
    """Owns the stream's pipeline, ingest and encoders. `inbox` brings the server's messages; `send` is thread-safe."""

    def __init__(self, start: Message, context: Context, inbox: SimpleQueue[Message], send: Send) -> None:
        self._stream = str(start["stream"])
        self._allow_files = bool(start.get("allow_files"))
        self._assets = Path(start["assets"]) if start.get("assets") else None
        self._context = context
        self._inbox = inbox
        self._send = send
        self._scene = Scene.model_validate(start.get("scene") or {})
        self._revision = int(start.get("revision", 0))
        self._rendered_revision = -1
        self._watched = False                       # somebody takes pictures
        self._light_clients = 0
        self.frames: Newest[Decoded] = Newest(BURST_S)
        ladder = [Rendition.model_validate(rendition) for rendition in start.get("renditions") or []]
        self._encoders = Encoders(self._on_packet, ladder or LADDER, start.get("bitrate_bps"))
        self._clock = OutputClock(int(start.get("timestamp", 0)))
        self._sound = Sound(self._clock, self._on_sound)
        self._statistics = RollingStatistics()
        self._budget = FrameBudget()
        self._skipped = 0                           # frames that the budget gave up
        self._ingest: Ingest | None = None
        self._frames_in_before = 0
        self._compositor: Compositor | None = None
        self._last: tuple[YuvFrame, Decoded] | None = None
        self._newest_composite: YuvFrame | None = None
        self._frame_number = 0
        self._rendered = 0
        self._last_render = 0.0
        self._errors: dict[str, str] = {}
        self._state = StateReport(send)
        self._snapshots = Snapshots(send)
        self._running = True
        self._heart = Heartbeat(self._send_statistics)
        self._set_source(start.get("source"))

    # -- messages ---------------------------------------------------------------------------------------------------

    def run(self) -> None:
        """Until `stop` comes. Raises what an encode thread or the sound thread died of."""
        self._heart.allow(STEP_ALLOWANCE_S)
        self._heart.start()
        while self._running:
            self._heart.allow(STEP_ALLOWANCE_S)
            self._read_inbox()
            decoded = self.frames.take(timeout=REPEAT_INTERVAL_S)
            self._encoders.tend()
            if self._sound.error is not None:
                raise self._sound.error
            if decoded is not None:
                self._process(decoded)
            elif self._watched:
                self._repeat()

    def _read_inbox(self) -> None:
        while True:
            try:
                message = self._inbox.get_nowait()
            except Empty:
                return
            self._obey(message)

    def _obey(self, message: Message) -> None:
        kind = message["type"]
        if kind == "scene":
            before = self._scene.lighting
            self._scene, self._revision = Scene.model_validate(message["scene"]), int(message["revision"])
            self._heart.allow(SCENE_ALLOWANCE_S if self._scene.lighting == before else OPEN_ALLOWANCE_S)
            if self._compositor is not None:
                self._compositor.disturb()
        elif kind == "source":
            self._set_source(message["source"])
        elif kind == "demand":
            self._demand(set(message["tracks"]), int(message["lights"]))
        elif kind == "keyframe":
            self._encoders.request_keyframe(str(message["track"]))
        elif kind == "bitrate":
            self._encoders.set_bitrate(message["bps"], message.get("track"))
            self._report_output()
        elif kind == "snapshot":
            self._snapshot(int(message["request"]))
        elif kind == "stop":
            self._running = False
        else:
            logger.warning("message type %r is not known", kind)

    def _demand(self, tracks: set[str], light_clients: int) -> None:
        self._encoders.want(tracks - {AUDIO})
        self._sound.want(AUDIO in tracks)
        self._watched, self._light_clients = bool(self._encoders.wanted), light_clients

    def _set_source(self, url: str | None) -> None:
        if self._ingest is not None:
            self._frames_in_before += self._ingest.frames_in
            self._ingest.stop()
            self._ingest = None
        if url is None:
            self._state.source("idle", None)
            return
        self._ingest = Ingest(url, allow_files=self._allow_files, frames=self.frames, on_state=self._on_source,
                              clock=self._clock, sound=self._sound)

    def _on_source(self, source: str, detail: str | None, info: SourceInfo | None) -> None:
        """Called from the ingest thread."""
        if info is not None:
            self._encoders.fps = info.fps
        self._state.source(source, detail, info)

    # -- frames -----------------------------------------------------------------------------------------------------

    def _process(self, decoded: Decoded) -> None:
        compositor = self._compositor or self._open(decoded)
        if compositor is None:
            return
        self._state.picture(decoded.frame, compositor.size)
        self._frame_number += 1
        if self._watched and self._frame_number % self._budget.effort.frame_step:
            self._skipped += 1
            return
        started = time.perf_counter()
        try:
            picture = compositor.planes(decoded.frame)
        except PictureError as error:
            self._state.source("lost", str(error))
            return
        self._last = (picture, decoded)
        if self._watched or self._light_clients:
            self._render(compositor, picture, decoded, started)

    def _repeat(self) -> None:
        """Render the last frame again: the source is silent, the scene may have changed."""
        if self._last is None or self._compositor is None or time.monotonic() - self._last_render <= REPEAT_AFTER_S:
            return
        picture, decoded = self._last
        now = time.monotonic()
        again = Decoded(decoded.frame, decoded.pts, now, time.time(), self._clock.moment(None, now))
        self._render(self._compositor, picture, again, time.perf_counter())

    def _open(self, decoded: Decoded) -> Compositor | None:
        """Fix the output geometry by the first frame. None when it cannot be processed."""
        try:
            size = output_size(decoded.frame.width, decoded.frame.height)
        except PictureError as error:
            self._state.source("lost", str(error))
            return None
        self._heart.allow(OPEN_ALLOWANCE_S)
        self._compositor = Compositor(self._context, size, self._assets)
        self._report_output()
        return self._compositor

    def _report_output(self) -> None:
        if self._compositor is not None:
            self._state.output(self._compositor.size, self._encoders.renditions(self._compositor.size))

    def _render(self, compositor: Compositor, picture: YuvFrame, decoded: Decoded, started: float) -> None:
        timestamp = self._clock.ticks(decoded.moment)
        if self._watched:
            self._composite(compositor, picture, decoded, started, timestamp)
        else:
            self._budget.rest()
            light, stages = compositor.analyse(picture, self._scene.lighting, decoded.decoded_at)
            self._statistics.add((time.perf_counter() - started) * 1e3, stages)
            self._send_lights(light, decoded, timestamp)
        self._rendered += 1
        self._rendered_revision = self._revision
        self._last_render = time.monotonic()

    def _composite(self, compositor: Compositor, picture: YuvFrame, decoded: Decoded, started: float, timestamp: int) -> None:
        """Composite the picture and hand it to the encoders; then read its light, for the next one."""
        moment = decoded.decoded_at
        made = compositor.composite(picture, self._scene, moment)
        render_ms = (time.perf_counter() - started) * 1e3
        self._encoders.put(Composited(made.picture, made.video, self._frame_number, timestamp, moment, render_ms, made.stages,
                                      self._revision))
        self._newest_composite, self._errors = made.picture, made.errors
        self._statistics.touched_fraction = made.touched_fraction
        interval_s = self._budget.effort.frame_step / self._encoders.fps
        found, more = compositor.read_light(made, self._scene.lighting, moment, interval_s, every_frame=self._light_clients > 0)
        if found is not None:
            self._send_lights(found, decoded, timestamp)
        self._statistics.add(render_ms, made.stages | more)
        lost = self.frames.dropped + self._encoders.frames_lost
        if self._budget.feed(moment, render_ms / 1e3, lost, compositor.situation(1 / self._encoders.fps)):
            compositor.spend(self._budget.effort)

    def _send_lights(self, light: FrameLight, decoded: Decoded, timestamp: int) -> None:
        message = light_message(light, stream=self._stream, frame=self._frame_number, pts=decoded.pts,
                                rtp_timestamp=timestamp & 0xFFFFFFFF, captured_at=decoded.captured_at)
        self._send({"type": "lights", "message": message}, b"")

    def _on_packet(self, track: str, payload: bytes, is_keyframe: bool, item: Composited) -> None:
        self._send({"type": "packet", "track": track, "frame": item.frame, "timestamp": item.timestamp,
                    "keyframe": is_keyframe, "revision": item.revision, "decoded_at": item.decoded_at,
                    "render_ms": round(item.render_ms, 3),
                    "stages_ms": {name: round(value, 3) for name, value in item.stages_ms.items()}}, payload)

    def _on_sound(self, payload: bytes, timestamp: int, decoded_at: float) -> None:
        self._send({"type": "packet", "track": AUDIO, "timestamp": timestamp, "keyframe": True, "decoded_at": decoded_at}, payload)

    def _snapshot(self, request: int) -> None:
        picture = self._newest_composite
        if self._compositor is not None and self._last is not None and not self._watched:
            picture = self._compositor.still(self._last[0], self._scene)
        self._snapshots.answer(request, picture)

    def _send_statistics(self) -> None:
        usage = resource.getrusage(resource.RUSAGE_SELF)
        self._send({
            "type": "stats", "frames_in": self._frames_in_before + (self._ingest.frames_in if self._ingest else 0),
            "frames_rendered": self._rendered, "frames_encoded": self._encoders.frames_encoded,
            "frames_dropped": self.frames.dropped + self._encoders.frames_dropped + self._skipped, "fps": self._statistics.fps(),
            "render_ms": self._statistics.render_ms(), "stages_ms": self._statistics.stages_ms(),
            "touched_fraction": round(self._statistics.touched_fraction, 5),
            "cpu_seconds": round(usage.ru_utime + usage.ru_stime, 3), "scene_revision": self._rendered_revision,
            "light_interval": round(self._compositor.light_interval, 2) if self._compositor else 1.0,
            "quality": self._budget.report, "scene_errors": self._errors, "discontinuities": self._clock.discontinuities,
            "tracks": self._encoders.report()}, b"")

    def close(self) -> None:
        """Stop all, join all, release all."""
        self._heart.close()
        if self._ingest is not None:
            self._ingest.stop()
        self._encoders.close()
        self._sound.close()
        self._snapshots.close()
        if self._compositor is not None:
            self._compositor.release()

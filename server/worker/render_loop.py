"""The worker's main thread: takes the newest frame, renders it, sends what it found, hands the picture to the encoder."""

from __future__ import annotations

import logging
import resource
import threading
import time
from collections.abc import Callable
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

import numpy as np

from renderer.frame import YuvFrame
from renderer.gl import Context
from renderer.light.reading import FrameLight
from renderer.pipeline import Pipeline
from renderer.scene import Scene
from server.worker.encode import Composited, EncodeThread
from server.worker.frame_budget import FrameBudget
from server.worker.ingest import Ingest
from server.worker.light_follower import LightFollower
from server.worker.light_message import light_message
from server.worker.messages import Message
from server.worker.named_thread import NamedThread
from server.worker.newest import Newest
from server.worker.output_clock import OutputClock
from server.worker.picture import FramePool, PictureError, PictureReader, output_size, picture_flags
from server.worker.snapshots import Snapshots
from server.worker.source import Decoded, SourceInfo
from server.worker.statistics import RollingStatistics

logger = logging.getLogger(__name__)
HEARTBEAT_S = 0.5
STEP_ALLOWANCE_S = 1.5    # the main thread counts as alive for this long after each step of its loop,
SCENE_ALLOWANCE_S = 6.0   # for this long after a new scene, whose models it may have to load,
OPEN_ALLOWANCE_S = 25.0   # and for this long while the driver compiles the shaders of a new geometry or other methods
BURST_S = 0.04            # of two frames that come within this time, both are rendered
REPEAT_AFTER_S = 0.4      # without a new frame, the last one is rendered again so that edits of the scene are seen
REPEAT_INTERVAL_S = 0.1
Send = Callable[[Message, bytes], None]


class RenderLoop:
    """Owns the stream's pipeline, ingest and encoder. `inbox` brings the server's messages; `send` is thread-safe."""

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
        self._encode = EncodeThread(self._on_packet)
        self._encode.set_bitrate(start.get("bitrate_bps"))
        self._clock = OutputClock(int(start.get("timestamp", 0)))
        self._statistics = RollingStatistics()
        self._budget = FrameBudget()
        self._skipped = 0                           # frames that the budget gave up
        self._ingest: Ingest | None = None
        self._frames_in_before = 0
        self._pipeline: Pipeline | None = None
        self._follower: LightFollower | None = None
        self._reader: PictureReader | None = None
        self._pool: FramePool | None = None
        self._last: tuple[YuvFrame, Decoded] | None = None
        self._newest_composite: YuvFrame | None = None
        self._frame_number = 0
        self._rendered = 0
        self._last_render = 0.0
        self._errors: dict[str, str] = {}
        self._state: dict[str, Any] = {"source": "idle", "detail": None, "input": None, "output": None, "flags": []}
        self._state_lock = threading.Lock()
        self._snapshots = Snapshots(send)
        self._running = True
        self._alive_until = 0.0
        self._closed = threading.Event()
        self._heart = NamedThread(target=self._beat, name="heartbeat", daemon=True)
        self._set_source(start.get("source"))

    # -- messages ---------------------------------------------------------------------------------------------------

    def run(self) -> None:
        """Until `stop` comes. Raises what the encode thread died of."""
        self._allow(STEP_ALLOWANCE_S)
        self._heart.start()
        while self._running:
            self._allow(STEP_ALLOWANCE_S)
            self._read_inbox()
            decoded = self.frames.take(timeout=REPEAT_INTERVAL_S)
            if self._encode.error is not None:
                raise self._encode.error
            if decoded is not None:
                self._process(decoded)
            elif self._last is not None and self._watched and time.monotonic() - self._last_render > REPEAT_AFTER_S:
                self._repeat()

    def _allow(self, seconds: float) -> None:
        """The main thread may be busy for this long before the server takes it for dead."""
        self._alive_until = max(self._alive_until, time.monotonic() + seconds)

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
            self._allow(SCENE_ALLOWANCE_S if self._scene.lighting == before else OPEN_ALLOWANCE_S)
            if self._follower is not None:
                self._follower.disturb()
        elif kind == "source":
            self._set_source(message["source"])
        elif kind == "demand":
            self._watched, self._light_clients = bool(message["tracks"]), int(message["lights"])
        elif kind == "keyframe":
            self._encode.request_keyframe()
        elif kind == "bitrate":
            self._encode.set_bitrate(message["bps"])
        elif kind == "snapshot":
            self._snapshot(int(message["request"]))
        elif kind == "stop":
            self._running = False
        else:
            logger.warning("message type %r is not known", kind)

    def _set_source(self, url: str | None) -> None:
        if self._ingest is not None:
            self._frames_in_before += self._ingest.frames_in
            self._ingest.stop()
            self._ingest = None
        if url is None:
            self._report_state(source="idle", detail=None)
            return
        self._ingest = Ingest(url, allow_files=self._allow_files, frames=self.frames, on_state=self._on_source)

    # -- state, called from several threads -------------------------------------------------------------------------

    def _on_source(self, source: str, detail: str | None, info: SourceInfo | None) -> None:
        changes: dict[str, Any] = {"source": source, "detail": detail}
        if info is not None:
            changes["input"] = {"width": info.width, "height": info.height, "fps": info.fps, "codec": info.codec,
                                "pix_fmt": info.pix_fmt}
            self._encode.fps = info.fps
        if source == "connecting" and self._state["source"] == "lost":
            return  # still lost, as a person sees it, until a frame comes
        self._report_state(**changes)

    def _report_state(self, **changes: Any) -> None:
        with self._state_lock:
            state = {**self._state, **changes}
            if state == self._state:
                return
            self._state = state
            self._send({"type": "state", **state}, b"")

    # -- frames -----------------------------------------------------------------------------------------------------

    def _process(self, decoded: Decoded) -> None:
        if self._pipeline is None and not self._open_pipeline(decoded):
            return
        assert self._reader is not None
        frame = decoded.frame
        flags = picture_flags(frame.width, frame.height, self._reader.size, frame.format.name)
        geometry = {"width": frame.width, "height": frame.height, "pix_fmt": frame.format.name}
        self._report_state(flags=flags, input={**(self._state["input"] or {}), **geometry})
        self._frame_number += 1
        if self._watched and self._frame_number % self._budget.effort.frame_step:
            self._skipped += 1
            return
        started = time.perf_counter()
        try:
            picture = self._reader.read(frame)
        except PictureError as error:
            self._report_state(source="lost", detail=str(error))
            return
        self._last = (picture, decoded)
        if self._watched or self._light_clients:
            self._render(picture, decoded, started, self._clock.timestamp(decoded.pts, decoded.decoded_at))

    def _repeat(self) -> None:
        """Render the last frame again: the source is silent, the scene may have changed."""
        assert self._last is not None
        picture, decoded = self._last
        now = time.monotonic()
        again = Decoded(decoded.frame, decoded.pts, now, time.time())
        self._render(picture, again, time.perf_counter(), self._clock.timestamp(None, now))

    def _open_pipeline(self, decoded: Decoded) -> bool:
        """Fix the output geometry by the first frame. False when it cannot be processed."""
        try:
            size = output_size(decoded.frame.width, decoded.frame.height)
        except PictureError as error:
            self._report_state(source="lost", detail=str(error))
            return False
        self._allow(OPEN_ALLOWANCE_S)
        self._reader, self._pool = PictureReader(size), FramePool(size)
        self._pipeline = Pipeline(self._context, YuvFrame, size, assets=self._assets)
        warm_up(self._pipeline, size)
        self._follower = LightFollower(self._pipeline, size[0])
        self._report_state(output={"width": size[0], "height": size[1], "bitrate_bps": self._encode.bitrate(size)})
        return True

    def _render(self, picture: YuvFrame, decoded: Decoded, started: float, timestamp: int) -> None:
        assert self._pipeline is not None
        assert self._follower is not None
        self._follower.look(picture)
        if self._watched:
            self._composite(picture, decoded, started, timestamp)
        else:
            self._budget.rest()
            light, timings = self._pipeline.analyse(picture, decoded.decoded_at, self._scene.lighting)
            self._statistics.add((time.perf_counter() - started) * 1e3, timings.stages)
            self._follower.take(light, decoded.decoded_at)
            self._send_lights(light, decoded, timestamp)
        self._rendered += 1
        self._rendered_revision = self._revision
        self._last_render = time.monotonic()

    def _composite(self, picture: YuvFrame, decoded: Decoded, started: float, timestamp: int) -> None:
        """Composite the picture and hand it to the encoder; then read its light, for the next one."""
        assert self._pipeline is not None
        assert self._pool is not None
        assert self._follower is not None
        output, video = self._pool.take(picture.format)
        light = self._follower.light
        rendered = self._pipeline.render(picture, self._scene, light=light, moment=decoded.decoded_at, output=output)
        render_ms = (time.perf_counter() - started) * 1e3
        stages, self._errors = rendered.timings.stages, rendered.errors
        self._encode.pictures.put(Composited(output, video, self._frame_number, timestamp, decoded.decoded_at, render_ms, stages,
                                             self._revision))
        self._newest_composite = output
        self._statistics.touched_fraction = rendered.touched_fraction
        found: FrameLight | None = rendered.light
        if light is None:
            self._follower.take(rendered.light, decoded.decoded_at)
        else:
            interval_s = self._budget.effort.frame_step / self._encode.fps
            found, more = self._follower.follow(decoded.decoded_at, interval_s, self._scene.lighting,
                                                every_frame=self._light_clients > 0)
            stages = stages | more
        if found is not None:
            self._send_lights(found, decoded, timestamp)
        self._statistics.add(render_ms, stages)
        self._balance(decoded.decoded_at, render_ms / 1e3)

    def _balance(self, moment: float, render_s: float) -> None:
        """Give accuracy up, or take it back, by how long the frame took."""
        assert self._pipeline is not None
        assert self._follower is not None
        lost = self.frames.dropped + self._encode.pictures.dropped
        if self._budget.feed(moment, render_s, lost, self._follower.situation(1 / self._encode.fps)):
            self._pipeline.quality = self._budget.effort.quality
            self._follower.tolerance = self._budget.effort.light_tolerance

    def _send_lights(self, light: FrameLight, decoded: Decoded, timestamp: int) -> None:
        message = light_message(light, stream=self._stream, frame=self._frame_number, pts=decoded.pts,
                                rtp_timestamp=timestamp & 0xFFFFFFFF, captured_at=decoded.captured_at)
        self._send({"type": "lights", "message": message}, b"")

    def _on_packet(self, payload: bytes, is_keyframe: bool, item: Composited) -> None:
        self._send({"type": "packet", "track": "full/h264", "frame": item.frame, "timestamp": item.timestamp,
                    "keyframe": is_keyframe, "revision": item.revision, "decoded_at": item.decoded_at,
                    "render_ms": round(item.render_ms, 3),
                    "stages_ms": {name: round(value, 3) for name, value in item.stages_ms.items()}}, payload)

    def _snapshot(self, request: int) -> None:
        picture = self._newest_composite
        if self._pipeline is not None and self._last is not None and not self._watched:
            rendered = self._pipeline.render(self._last[0], self._scene)
            assert isinstance(rendered.frame, YuvFrame)
            picture = rendered.frame
        self._snapshots.answer(request, picture)

    def _beat(self) -> None:
        """Statistics twice a second for as long as the main thread makes progress; without them the server replaces us."""
        while not self._closed.wait(HEARTBEAT_S):
            if time.monotonic() < self._alive_until:
                self._send_statistics()

    def _send_statistics(self) -> None:
        usage = resource.getrusage(resource.RUSAGE_SELF)
        self._send({
            "type": "stats", "frames_in": self._frames_in_before + (self._ingest.frames_in if self._ingest else 0),
            "frames_rendered": self._rendered, "frames_encoded": self._encode.frames_encoded,
            "frames_dropped": self.frames.dropped + self._encode.pictures.dropped + self._skipped, "fps": self._statistics.fps(),
            "render_ms": self._statistics.render_ms(), "stages_ms": self._statistics.stages_ms(),
            "touched_fraction": round(self._statistics.touched_fraction, 5),
            "cpu_seconds": round(usage.ru_utime + usage.ru_stime, 3), "scene_revision": self._rendered_revision,
            "light_interval": round(self._follower.mean_interval, 2) if self._follower else 1.0,
            "quality": self._budget.report, "scene_errors": self._errors, "discontinuities": self._clock.discontinuities}, b"")

    def close(self) -> None:
        """Stop all, join all, release all."""
        self._closed.set()
        self._heart.join(1.0)
        if self._ingest is not None:
            self._ingest.stop()
        self._encode.stop()
        self._snapshots.close()
        if self._pipeline is not None:
            self._pipeline.release()


def warm_up(pipeline: Pipeline, size: tuple[int, int]) -> None:
    """Run every shader once, so that no frame of the stream waits for the driver's compiler."""
    width, height = size
    grey = YuvFrame(np.full((height, width), 126, np.uint8), *(np.full((height // 2, width // 2), 128, np.uint8),) * 2)
    grey.y[height // 4:height // 4 + max(2, height // 64), :max(2, width // 64)] = 235  # a light, so that it casts a shadow
    objects: list[dict[str, Any]] = [
        {"id": "warm-up-1", "mesh": "box", "position": [0, -1.1, -3], "material": {"roughness": 0.5}},
        {"id": "warm-up-2", "mesh": "sphere", "position": [3, -1.1, 0], "material": {"metallic": 1, "roughness": 0}},
        {"id": "warm-up-3", "mesh": "sphere", "position": [0.7, -1.1, -3], "material": {"roughness": 0.3}}]
    pipeline.render(grey, Scene.model_validate({"objects": objects}))
    pipeline.compile_variants()
    pipeline.render(grey, Scene())
    pipeline.reset()

"""Times every stage of the live frame path on the demo's own clip and scene, one frame after another.

Nothing else runs meanwhile, so a row is what a stage costs, not how long it waits for the others; `mr360 demo --report`
measures that. Wall time is what passes with the renderer's own threads at work, processor time what all of them use.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import av
from av.video.frame import VideoFrame

from renderer.color import YuvFormat
from renderer.frame import YuvFrame
from renderer.gl import Context
from renderer.pipeline import Pipeline
from renderer.scene import Scene
from renderer.timings import Timings
from server.demo.clip import demo_clip
from server.demo.sample_scene import GROUND_Y, sample_scene
from server.worker.h264 import H264Encoder, default_bitrate
from server.worker.output_clock import CLOCK_RATE
from server.worker.picture import FramePool, PictureReader
from server.worker.statistics import percentiles
from server.worker.warm_up import warm_up

WARM_UP_FRAMES = 15


class _Samples:
    """Milliseconds by row: wall time, and processor time of the whole process."""

    def __init__(self) -> None:
        self.wall: dict[str, list[float]] = {}
        self.processor: dict[str, list[float]] = {}

    @contextmanager
    def row(self, name: str) -> Iterator[None]:
        wall, processor = time.perf_counter(), time.process_time()
        yield
        self.wall.setdefault(name, []).append((time.perf_counter() - wall) * 1e3)
        self.processor.setdefault(name, []).append((time.process_time() - processor) * 1e3)

    def add_stages(self, timings: Timings) -> None:
        for name, milliseconds in timings.stages.items():
            self.wall.setdefault(f"  {name}", []).append(milliseconds)

    def as_json(self) -> dict[str, Any]:
        return {name: {"wall_ms": percentiles(values), "processor_ms": percentiles(self.processor.get(name, []))}
                for name, values in self.wall.items()}


def frame_path(context: Context, count: int, width: int, fps: int) -> dict[str, Any]:
    """Frames of the demo's clip through decoder, renderer and encoder; the demo's scene, five objects, then none."""
    clip, size = demo_clip(width, fps), (width, width // 2)
    scenes = {"demo": Scene.model_validate(sample_scene()), "five objects": five_objects(), "empty": Scene()}
    return {"size": size, "frames": count,
            "scenes": {name: _run(context, clip, scene, size, fps, count).as_json() for name, scene in scenes.items()}}


def five_objects() -> Scene:
    """The demo's scene with a mirror and a cylinder of glossy metal."""
    scene = sample_scene()
    scene["objects"] += [
        {"id": "mirror", "mesh": "sphere", "position": [0.7, GROUND_Y + 0.3, -1.8], "scale": [0.6] * 3,
         "material": {"base_color": [0.95, 0.95, 0.95], "metallic": 1.0, "roughness": 0.0}},
        {"id": "cylinder", "mesh": "cylinder", "position": [-0.7, GROUND_Y + 0.4, -1.9], "scale": [0.5, 0.8, 0.5],
         "material": {"base_color": [0.95, 0.75, 0.45], "metallic": 1.0, "roughness": 0.25}}]
    return Scene.model_validate(scene)


def _run(context: Context, clip: Path, scene: Scene, size: tuple[int, int], fps: int, count: int) -> _Samples:
    pipeline = Pipeline(context, YuvFrame, size)
    warm_up(pipeline, size)
    reader = PictureReader(size)
    encoder = H264Encoder(size, fps, default_bitrate(*size), YuvFormat())
    samples, pool, light = _Samples(), FramePool(size), None
    for index, frame in enumerate(_decoded(clip, count + WARM_UP_FRAMES, samples)):
        picture = reader.read(frame)
        output, video = pool.take(picture.format)
        with samples.row("render"):
            rendered = pipeline.render(picture, scene, light=light, moment=index / fps, output=output)
        samples.add_stages(rendered.timings)
        with samples.row("read light"):
            light, timings = pipeline.read_light(index / fps)
        samples.add_stages(timings)
        with samples.row("prepare light"):
            timings = pipeline.prepare(light)
        samples.add_stages(timings)
        with samples.row("encode"):
            encoder.encode(video, index * CLOCK_RATE // fps, keyframe=False)
        if index + 1 == WARM_UP_FRAMES:
            samples.wall.clear()
            samples.processor.clear()
    pipeline.release()
    return samples


def _decoded(clip: Path, count: int, samples: _Samples) -> Iterator[VideoFrame]:
    """The clip's first `count` frames, again from the beginning if it is shorter."""
    while count > 0:
        with av.open(str(clip)) as container:
            stream = container.streams.video[0]
            stream.thread_type = "SLICE"
            frames = container.decode(stream)
            while count > 0:
                with samples.row("decode"):
                    frame = next(frames, None)
                if frame is None:
                    break
                yield frame
                count -= 1


def frame_path_table(report: dict[str, Any]) -> Iterator[str]:
    """The frame path as text."""
    width, height = report["size"]
    yield "THE FRAME PATH"
    yield (f"the demo's clip of {width}x{height} through decoder, renderer and encoder, {report['frames']} frames; milliseconds by "
           "stage")
    for name, rows in report["scenes"].items():
        yield f"{'scene ' + name:26}{'wall p50':>10}{'p95':>8}{'max':>8}{'cpu p50':>10}{'p95':>8}"
        for row, figures in rows.items():
            wall, processor = figures["wall_ms"], figures["processor_ms"]
            cpu = f"{processor['p50']:10.2f}{processor['p95']:8.2f}" if processor else ""
            yield f"{row:26}{wall['p50']:10.2f}{wall['p95']:8.2f}{wall['max']:8.2f}{cpu}"

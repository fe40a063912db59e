"""What a frame costs by number of objects, of triangles, of lamps: the pipeline alone, one frame after another.

Per frame: composite it by the light of the frame before, read its light, prepare it for the next. Live, the light is read less
often when there is no time. Decoding and encoding, which do not depend on any of this, are left out.
"""

from __future__ import annotations

import itertools
import math
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import av
import numpy as np

from renderer.color import YuvFormat
from renderer.equirectangular import pixel_directions
from renderer.frame import YuvFrame
from renderer.gl import Context
from renderer.pipeline import Pipeline
from renderer.scene import Scene
from server.bench.service_scene import knot_alone, knot_glb, objects_around, triangles_of
from server.demo.clip import demo_clip
from server.demo.watch import DemoError, StopError
from server.worker.picture import FramePool, PictureReader
from server.worker.statistics import percentiles
from server.worker.warm_up import warm_up

OBJECTS = (1, 5, 10, 20, 50)
TRIANGLES = (6_000, 20_000, 70_000, 200_000)
LAMPS = (1, 2, 4, 8)
CLIP_FRAMES = 60            # shown forwards and backwards in turn, so that nothing jumps
LAMP_RADIUS_RAD, LAMP_ELEVATION_RAD = math.radians(3.0), math.radians(50.0)
ROOM_CODE, LAMP_CODE = 70.0, 235
NOISE_CODES, NOISY_FRAMES = 0.7, 8
TURN_RAD = math.radians(3.0)    # a frame
Report = dict[str, Any]
Scenes = Callable[[int], Scene]     # by the number of the frame


class Scaling:
    """Owns a GL context and a pipeline of one size. Models are made in `folder`. Every table gives its rows as they are measured.

    Raises GLUnavailableError; the tables raise DemoError when something could not be drawn, StopError when `stop` is set.
    """

    def __init__(self, width: int, fps: int, folder: Path, frames: int, warm_up_frames: int, teapot_triangles: int,
                 stop: threading.Event) -> None:
        self._size, self._fps, self._stop = (width, width // 2), fps, stop
        self._count, self._warm_up = frames, warm_up_frames
        self._folder = folder
        self._context = Context()
        self._pipeline = Pipeline(self._context, YuvFrame, self._size, assets=folder)
        warm_up(self._pipeline, self._size)
        self._triangles = {"teapot": teapot_triangles}
        self._still = self._decoded(still=True)
        self._sun = self._decoded(still=False)

    @property
    def renderer(self) -> str:
        return self._context.renderer

    def objects(self, counts: Sequence[int] = OBJECTS) -> Iterator[Report]:
        for count in counts:
            scene = objects_around(count)
            yield self._row(count, f"{triangles_of(scene, self._triangles)} triangles", scene)

    def triangles(self, counts: Sequence[int] = TRIANGLES) -> Iterator[Report]:
        for wanted in counts:
            name = f"knot-{wanted}"
            model, count = knot_glb(wanted)
            (self._folder / f"{name}.glb").write_bytes(model)
            yield self._row(count, "one object", knot_alone(name))

    def lamps(self, counts: Sequence[int] = LAMPS) -> Iterator[Report]:
        """Of five objects, the largest a teapot."""
        scene = Scene.model_validate(objects_around(5))
        for count in counts:
            frames = lamp_frames(self._size, count)
            cell = self._cost(frames, lambda _: scene)
            yield {"count": count, "note": f"{cell['lights']} found", "conditions": {"still": cell}}

    def _row(self, count: int, note: str, scene_json: Report) -> Report:
        scene = Scene.model_validate(scene_json)
        still = self._cost(self._still, lambda _: scene)
        sun = self._cost(self._sun, lambda _: scene)
        turning = self._cost(self._still, lambda index: _with_first_turned(scene, index))
        return {"count": count, "note": note, "conditions": {"still": still, "moving sun": sun, "still, one object turns": turning}}

    def _cost(self, frames: Sequence[YuvFrame], scene_of: Scenes) -> Report:
        """Percentiles of wall milliseconds, means of the stages, and the mean of the processor time of all of it."""
        self._pipeline.reset()
        pool, light = FramePool(self._size), None
        render_ms: list[float] = []
        light_ms: list[float] = []
        stages: dict[str, float] = {}
        processor_s = 0.0
        for index, frame in zip(range(self._warm_up + self._count), _to_and_fro(frames), strict=False):
            scene, moment = scene_of(index), index / self._fps
            output, _ = pool.take(frame.format)
            if self._stop.is_set():
                raise StopError
            if index == self._warm_up:
                render_ms, light_ms, stages, processor_s = [], [], {}, 0.0
            before = time.process_time()
            started = time.perf_counter()
            rendered = self._pipeline.render(frame, scene, light=light, moment=moment, output=output)
            rendered_at = time.perf_counter()
            light, reading = self._pipeline.read_light(moment)
            preparing = self._pipeline.prepare(light)
            light_ms.append((time.perf_counter() - rendered_at) * 1e3)
            render_ms.append((rendered_at - started) * 1e3)
            processor_s += time.process_time() - before
            for name, milliseconds in itertools.chain(*(each.stages.items() for each in (rendered.timings, reading, preparing))):
                stages[name] = stages.get(name, 0.0) + milliseconds / self._count
            if rendered.errors:
                raise DemoError(f"objects could not be drawn: {rendered.errors}")
        return {"render_ms": percentiles(render_ms), "light_ms": percentiles(light_ms),
                "stages_ms": {name: round(mean, 3) for name, mean in stages.items()},
                "cpu_ms_per_frame": round(processor_s * 1e3 / self._count, 3),
                "lights": 0 if light is None else len(light.detection.lights)}

    def _decoded(self, still: bool) -> list[YuvFrame]:
        reader, frames = PictureReader(self._size), []
        with av.open(str(demo_clip(self._size[0], self._fps, still))) as container:
            for frame in itertools.islice(container.decode(video=0), CLIP_FRAMES):
                picture = reader.read(frame)
                frames.append(YuvFrame(picture.y.copy(), picture.u.copy(), picture.v.copy(), picture.format))
        return frames

    def release(self) -> None:
        self._pipeline.release()
        self._context.release()


def lamp_frames(size: tuple[int, int], count: int) -> list[YuvFrame]:
    """A grey room whose ceiling has so many round lamps, clipped as a camera clips them, around the camera; with sensor noise."""
    width, height = size
    directions = pixel_directions(height, width)
    room = ROOM_CODE + 20 * directions[..., 1]
    is_lamp = np.zeros(room.shape, bool)
    for index in range(count):
        azimuth = 2 * math.pi * (index + 0.25) / count
        lamp = [math.cos(LAMP_ELEVATION_RAD) * math.sin(azimuth), math.sin(LAMP_ELEVATION_RAD),
                -math.cos(LAMP_ELEVATION_RAD) * math.cos(azimuth)]
        is_lamp |= directions @ np.array(lamp) > math.cos(LAMP_RADIUS_RAD)
    grey = np.full((height // 2, width // 2), 128, np.uint8)
    rng = np.random.default_rng(11)
    noisy = (room + rng.normal(0, NOISE_CODES, room.shape) for _ in range(NOISY_FRAMES))
    return [YuvFrame(np.where(is_lamp, LAMP_CODE, luma.round()).astype(np.uint8), grey, grey, YuvFormat("bt709", False))
            for luma in noisy]


def _to_and_fro(frames: Sequence[YuvFrame]) -> Iterator[YuvFrame]:
    return itertools.cycle([*frames, *frames[-2:0:-1]])


def _with_first_turned(scene: Scene, index: int) -> Scene:
    half = 0.5 * TURN_RAD * index
    first = scene.objects[0].model_copy(update={"rotation": (0.0, math.sin(half), 0.0, math.cos(half))})
    return scene.model_copy(update={"objects": (first, *scene.objects[1:])})

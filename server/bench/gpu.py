"""`make bench-gpu`: what each stage of a frame takes on the graphics processor, by GL timer queries, beside the wall time.

`python -m server.bench.gpu [--sizes 2048x1024,…] [--frames 200] [--require-gpu] [--json FILE]`. Five objects under the demo's sun,
which moves in every frame; its light is read and prepared for each. With a software renderer both are times of the processor.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import moderngl

from renderer.color import YuvFormat
from renderer.frame import YuvFrame
from renderer.gl import Context, GLUnavailableError
from renderer.light.reading import FrameLight
from renderer.pipeline import Pipeline
from renderer.scene import Scene
from renderer.timings import Timings
from server.bench.machine import machine_record
from server.bench.stages import five_objects
from server.demo.camera import Camera
from server.worker.statistics import percentiles
from server.worker.warm_up import warm_up

BAD_INPUT = 2
SIZES = "2048x1024,3840x1920,7680x3840"
MOMENTS = 8         # of the camera, one after another
WARM_UP = 20


class QueriedTimings(Timings):
    """Each stage between two time stamps of the graphics processor as well."""

    def __init__(self, context: Context) -> None:
        super().__init__()
        self._context = context
        self._queries: list[tuple[str, moderngl.Query]] = []

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        query = self._context.gl.query(time=True)
        with super().stage(name), query:
            yield
        self._queries.append((name, query))

    def on_gpu(self) -> dict[str, float]:
        """Milliseconds of each stage; waits for all of it."""
        found: dict[str, float] = {}
        for name, query in self._queries:
            found[name] = found.get(name, 0.0) + query.elapsed / 1e6
        return found


def main() -> int:
    parser = argparse.ArgumentParser(prog="bench-gpu", description="stage times by GL timer queries")
    parser.add_argument("--sizes", default=SIZES, help=f"default {SIZES}")
    parser.add_argument("--frames", type=int, default=200, help="measured of each size, default 200")
    parser.add_argument("--require-gpu", action="store_true", help="refuse a software renderer")
    parser.add_argument("--json", type=Path, metavar="FILE", help="where to write the figures")
    arguments = parser.parse_args()
    try:
        sizes = [_size(text) for text in arguments.sizes.split(",")]
        if arguments.frames < 1:
            raise ValueError(f"--frames is {arguments.frames}, expected at least 1")
        context = Context(require_gpu=arguments.require_gpu)
        report: dict[str, Any] = {"machine": machine_record(context), "frames": arguments.frames, "sizes": {}}
        for size in sizes:
            report["sizes"]["{}x{}".format(*size)] = rows = measured(context, size, arguments.frames)
            print("\n".join(table(context.renderer, size, arguments.frames, rows)), flush=True)
        if arguments.json is not None:
            arguments.json.write_text(json.dumps(report, indent=1) + "\n")
    except (GLUnavailableError, ValueError, OSError) as error:
        print(f"bench-gpu: {' '.join(str(error).split())}", file=sys.stderr)
        return BAD_INPUT
    context.release()
    return 0


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    if not (width.isdigit() and height.isdigit() and int(width) == 2 * int(height)):
        raise ValueError(f"size is {text!r}, expected WIDTHxHEIGHT with width twice the height, such as 2048x1024")
    return int(width), int(height)


def measured(context: Context, size: tuple[int, int], frames: int) -> dict[str, dict[str, Any]]:
    """p50, p95 and max of each stage and of all, on the graphics processor and by the wall."""
    camera = Camera(size[0])
    pictures = [YuvFrame(*camera.frame(index / 30), YuvFormat("bt709", False)) for index in range(MOMENTS)]
    pipeline = Pipeline(context, YuvFrame, size)
    warm_up(pipeline, size)
    gpu: dict[str, list[float]] = {}
    wall: dict[str, list[float]] = {}
    scene, output, light = five_objects(), pictures[0].copy(), None
    for index in range(frames + WARM_UP):
        light, stages = _frame(context, pipeline, pictures[index % MOMENTS], scene, light, index / 30, output)
        for kept, found in ((gpu, stages[0]), (wall, stages[1])):
            for name, value in {**found, "all": sum(found.values())}.items():
                if index >= WARM_UP:
                    kept.setdefault(name, []).append(value)
    pipeline.release()
    return {name: {"gpu_ms": percentiles(gpu[name]), "wall_ms": percentiles(wall[name])} for name in wall}


def _frame(context: Context, pipeline: Pipeline, picture: YuvFrame, scene: Scene, light: FrameLight | None, moment: float,
           output: YuvFrame) -> tuple[FrameLight, tuple[dict[str, float], dict[str, float]]]:
    """One live frame: composited under the last light, then its own read and prepared."""
    timings = QueriedTimings(context)
    pipeline.new_timings = lambda: timings
    rendered = pipeline.render(picture, scene, light=light, moment=moment, output=output)
    found = rendered.light if light is None else pipeline.read_light(moment)[0]
    pipeline.prepare(found)
    pipeline.new_timings = Timings
    return found, (timings.on_gpu(), dict(timings.stages))


def table(renderer: str, size: tuple[int, int], frames: int, rows: dict[str, dict[str, Any]]) -> list[str]:
    lines = ["", f"{size[0]}x{size[1]}, {renderer}, {frames} frames after {WARM_UP}, milliseconds",
             f"{'':26}{'gpu p50':>10}{'p95':>9}{'wall p50':>11}{'p95':>9}"]
    for name, row in rows.items():
        gpu, wall = row["gpu_ms"], row["wall_ms"]
        lines.append(f"{name:26}{gpu['p50']:10.3f}{gpu['p95']:9.3f}{wall['p50']:11.3f}{wall['p95']:9.3f}")
    return lines


if __name__ == "__main__":
    sys.exit(main())

"""Only what a scene needs: what a live frame costs, and which stages it does not have, for scenes that need less and less."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from renderer.frame import YuvFrame
from renderer.scene import Scene
from renderer.timings import Timings
from server.bench.effort import Effort
from server.bench.frames import yuv_from_linear
from server.bench.pipelines import Pipelines
from server.bench.worlds import World, worlds
from server.demo.sample_scene import sample_scene

Array = NDArray[np.float64]
WARM_UP = 30            # a light that stays the same is believed to after a while
TURN = 2                # pixels a frame
IDLE_MS = 0.02          # what takes less has only looked whether it is needed
HEADS = {"place": "place", "upload": "upload", "radiance_map": "map", "highlights": "highlights", "lights": "lights",
         "irradiance": "irradiance", "glossy": "glossy", "shadows": "shadows", "objects_and_composite": "composite",
         "write": "write"}


@dataclass
class Need:
    """What one kind of scene cost: wall and processor milliseconds of each frame, milliseconds of each frame's stages."""

    name: str
    wall: list[float] = field(default_factory=list)
    processor: list[float] = field(default_factory=list)
    stages: list[dict[str, float]] = field(default_factory=list)
    touched: float = 0.0

    def stages_ms(self) -> dict[str, float | None]:
        """Median of each stage; None where it did not run."""
        medians = {name: float(np.median([frame.get(name, 0.0) for frame in self.stages])) for name in HEADS}
        return {name: milliseconds if milliseconds >= IDLE_MS else None for name, milliseconds in medians.items()}

    def as_json(self) -> dict[str, Any]:
        wall, processor = (np.percentile(values, [50, 95]).round(3).tolist() for values in (self.wall, self.processor))
        stages = self.stages_ms()
        return {"scene": self.name, "frames": len(self.wall), "ms_p50": wall[0], "ms_p95": wall[1], "cpu_ms_p50": processor[0],
                "cpu_ms_p95": processor[1], "touched_fraction": round(self.touched, 5),
                "skipped": [name for name, milliseconds in stages.items() if milliseconds is None],
                "stages_ms_p50": {name: None if ms is None else round(ms, 3) for name, ms in stages.items()}}


def needs(pipelines: Pipelines, effort: Effort) -> Iterator[Need]:
    """From the usual scene to none at all."""
    sun, overcast = worlds(effort.size, ("sun", "overcast"))
    usual = Scene.model_validate(sample_scene())
    yield _measured(pipelines, "usual: teapot, mirror, box; the light turns", usual, sun, effort.frames, TURN)
    yield _measured(pipelines, "the same, nothing changes", usual, sun, effort.frames, 0)
    yield _measured(pipelines, "the same, overcast: no light with a shadow", usual, overcast, effort.frames, TURN)
    yield _measured(pipelines, "the same, diffuse, without a ground", _diffuse_only(), sun, effort.frames, TURN)
    yield _measured(pipelines, "no objects", Scene(), sun, effort.frames, TURN)


def _diffuse_only() -> Scene:
    """The same objects, rough; without a ground under them."""
    document = sample_scene()
    for item in document["objects"]:
        item["material"] |= {"metallic": 0.0, "roughness": 1.0}
    return Scene.model_validate({**document, "ground": {"catcher": False}})


def _measured(pipelines: Pipelines, name: str, scene: Scene, world: World, count: int, turn: int) -> Need:
    still = yuv_from_linear(world.shown)
    pipeline, need = pipelines.of(still), Need(name)
    light = pipeline.render(still, scene).light
    for index in range(count + WARM_UP):
        frame = turned(still, turn * index)
        wall, processor = time.perf_counter(), time.process_time()
        rendered = pipeline.render(frame, scene, light=light, moment=index / 30)
        light, reading = pipeline.read_light(index / 30, scene.lighting)
        preparing = pipeline.prepare(light)
        if index >= WARM_UP:
            need.wall.append((time.perf_counter() - wall) * 1e3)
            need.processor.append((time.process_time() - processor) * 1e3)
            need.stages.append(_together(rendered.timings, reading, preparing))
        need.touched = rendered.touched_fraction
    return need


def _together(*timings: Timings) -> dict[str, float]:
    found: dict[str, float] = {}
    for one in timings:
        for name, milliseconds in one.stages.items():
            found[name] = found.get(name, 0.0) + milliseconds
    return found


def turned(frame: YuvFrame, pixels: int) -> YuvFrame:
    """A world that has turned by an even number of pixels."""
    return YuvFrame(np.roll(frame.y, pixels, axis=1), np.roll(frame.u, pixels // 2, axis=1), np.roll(frame.v, pixels // 2, axis=1),
                    frame.format)


def needs_table(found: list[Need]) -> Iterator[str]:
    yield "ONLY WHAT A SCENE NEEDS"
    yield "milliseconds of a live frame with reading and preparing the light, wall and processor time; then the median of each"
    yield "stage, `-` for one that did not run"
    yield (f"{'scene':46}{'p50':>8}{'p95':>8}{'cpu p50':>9}{'p95':>8}{'touched':>9} |"
           + "".join(f"{name:>11}" for name in HEADS.values()))
    for need in found:
        row = need.as_json()
        yield (f"{need.name:46}{row['ms_p50']:8.2f}{row['ms_p95']:8.2f}{row['cpu_ms_p50']:9.2f}{row['cpu_ms_p95']:8.2f}"
               f"{100 * need.touched:8.1f}% |"
               + "".join(f"{'-':>11}" if ms is None else f"{ms:11.2f}" for ms in need.stages_ms().values()))

"""The whole: two balls on the ground by each preset, and by ours with one stage of the papers', against `ball_reference.py`."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from renderer.color import srgb_from_linear
from renderer.equirectangular import solid_angles
from renderer.frame import RadianceFrame, RgbFrame
from renderer.light.inverse_tone_mapping import linear_from_radiance
from renderer.scene import PRESETS, STAGES, Lighting
from server.bench.effort import Effort
from server.bench.frames import yuv_from_linear
from server.bench.needs import turned
from server.bench.pipelines import Pipelines
from server.bench.rows import Mark, Row, relative
from server.bench.whole_scene import BALLS, REGIONS, Pixels, balls_scene, environment, looked_at, true_radiance
from server.bench.worlds import World, worlds

Array = NDArray[np.float64]
STAGE = "whole"
MEASURE = ("pixels of a diffuse ball, a glossy metal one (roughness 0.4) and the ground around them, as many of each, less "
           "float64 summation; each part in units of its own rms. `radiance`: from the radiance map; `camera`: from its 8 bit "
           "picture, clipped at white, as linear display light. Time: a live frame in a turning world: read and prepare the "
           "light, then render")
WARM_UP = 8
TURN = 2        # pixels a frame
INPUTS = ("radiance", "camera")


def variants() -> dict[str, tuple[Lighting, Mark]]:
    """Both presets; ours with each single stage as the papers have it."""
    found: dict[str, tuple[Lighting, Mark]] = {"default": (Lighting(), "default"), "paper": (Lighting(preset="paper"), "paper")}
    for stage in STAGES:
        lighting = Lighting.model_validate({stage: PRESETS["paper"][stage]})
        found[f"default, {stage} {PRESETS['paper'][stage]}"] = (lighting, "")
    return found


def whole_rows(pipelines: Pipelines, effort: Effort) -> Iterator[Row]:
    pixels = looked_at(effort.size, effort.pixels)
    for world in worlds(effort.size, effort.whole_worlds):
        background = world.radiance.reshape(-1, 3).astype(np.float64)
        truth = true_radiance(environment(world.sky, world.lights, world.sky), pixels, background, effort.texels)
        for name, (lighting, mark) in variants().items():
            times = live_times(pipelines, world, lighting, effort.frames // len(effort.whole_worlds))
            for given in INPUTS:
                found = rendered(pipelines, world, lighting, pixels, given)
                expected = truth if given == "radiance" else displayed(truth, world)
                yield Row(STAGE, name, world.name, by_region(found, expected), times, condition=given, mark=mark)
        nothing = flat_light(world, pixels)
        yield Row(STAGE, "constant ambient", world.name, by_region(nothing, truth), condition=INPUTS[0], mark="null")
        yield Row(STAGE, "constant ambient", world.name, by_region(displayed(nothing, world), displayed(truth, world)),
                  condition=INPUTS[1], mark="null")


def by_region(found: dict[str, Array], expected: dict[str, Array]) -> Array:
    """Errors of all regions, each in units of its own rms."""
    return np.concatenate([relative(found[region], expected[region]) for region in REGIONS])


def displayed(radiance: dict[str, Array], world: World) -> dict[str, Array]:
    """What the world's camera would show of it: linear, clipped at white."""
    return {region: np.minimum(world.exposure * values, 1.0) for region, values in radiance.items()}


def rendered(pipelines: Pipelines, world: World, lighting: Lighting, pixels: Pixels, given: str) -> dict[str, Array]:
    """(n, 3) by region, of a still frame: radiance, or display light by the camera's picture."""
    scene = balls_scene(lighting)
    if given == "radiance":
        frame = RadianceFrame(world.radiance)
        drawn = pipelines.of(frame).render(frame, scene).frame
        assert isinstance(drawn, RadianceFrame)
        whole = drawn.rgb.astype(np.float64)
    else:
        whole = photographed(pipelines, world, lighting)
    return {region: whole.reshape(-1, 3)[pixels.indices[region]] for region in REGIONS}


def picture(world: World) -> RgbFrame:
    """Of the world's camera."""
    return RgbFrame(np.round(255 * srgb_from_linear(world.shown)).astype(np.uint8))


def photographed(pipelines: Pipelines, world: World, lighting: Lighting) -> Array:
    """(height, width, 3) linear display light, before it is rounded to codes again; the camera's own where nothing is drawn."""
    frame = picture(world)
    touched = pipelines.of(frame).render(frame, balls_scene(lighting)).touched
    assert touched is not None
    whole = world.shown.copy()
    whole[touched.mask] = np.minimum(linear_from_radiance(touched.rgb[touched.mask]), 1.0)
    return whole


def flat_light(world: World, pixels: Pixels) -> dict[str, Array]:
    """What nothing but the frame's mean radiance gives: no direction, no reflection, no shadow."""
    mean = (world.radiance * solid_angles(*world.radiance.shape[:2])[..., None]).sum(axis=(0, 1)) / (4 * np.pi)
    found = {ball.name: np.broadcast_to(ball.color * mean, pixels.points[ball.name].shape) for ball in BALLS}
    return found | {"ground": world.radiance.reshape(-1, 3)[pixels.indices["ground"]].astype(np.float64)}


def live_times(pipelines: Pipelines, world: World, lighting: Lighting, count: int) -> Array:
    """Of so many frames of a world that turns; each is lit by the light of the one before, as in a stream."""
    still = yuv_from_linear(world.shown)
    frames = [turned(still, TURN * step) for step in range(count + WARM_UP)]
    pipeline, scene = pipelines.of(still), balls_scene(lighting)
    light, times = pipeline.render(frames[0], scene).light, []
    for index, frame in enumerate(frames):
        start = time.perf_counter()
        pipeline.render(frame, scene, light=light, moment=index / 30)
        light, _ = pipeline.read_light(index / 30, lighting)
        pipeline.prepare(light)
        times.append((time.perf_counter() - start) * 1e3)
    return np.array(times[WARM_UP:])

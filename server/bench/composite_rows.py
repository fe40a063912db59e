"""Compositing: a shadow that is known, on grounds whose albedo is known, in the picture of a camera."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np
from numpy.typing import NDArray

from renderer.color import linear_from_srgb, srgb_from_linear
from renderer.equirectangular import pixel_directions
from renderer.frame import RadianceFrame, RgbFrame
from renderer.light.detection import Detection, Light
from renderer.light.inverse_tone_mapping import OFFSET
from renderer.light.reading import FrameLight
from renderer.scene import Lighting, Scene
from server.bench.effort import Effort
from server.bench.frames import direction, yuv_from_linear
from server.bench.pipelines import Pipelines
from server.bench.rows import Mark, Row, relative, timed

Array = NDArray[np.float64]
STAGE = "composite"
MEASURE = ("linear display light of the ground in a shadow, less the picture without it times the shadow's ratio; in units of "
           "the rms of that. Tiles of albedo 0.08 to 0.8, by the exposure at which the picture shows the ground's albedo "
           "itself")
CAMERA_HEIGHT, SUN_SHARE = 1.6, 0.7
SCENE = "plate over tiles"
ALBEDOS = (0.08, 0.2, 0.4, 0.8)
EXPOSURES = (0.5, 1.0, 1.2)     # 1: what the additive method takes for granted
METHODS: tuple[tuple[str, Mark], ...] = (("ratio", "default"), ("additive", "paper"))
PLATE = {"id": "plate", "mesh": "box", "position": [0.0, -0.4, -2.6], "scale": [1.0, 0.1, 1.0],
         "material": {"base_color": [0, 0, 0], "roughness": 1.0}}


def composite_rows(pipelines: Pipelines, effort: Effort) -> Iterator[Row]:
    albedo = _tiles(effort.size)
    for exposure in EXPOSURES:
        light = _light(exposure)
        picture = albedo * exposure
        codes = RgbFrame(np.round(255 * srgb_from_linear(np.repeat(picture[..., None], 3, axis=2))).astype(np.uint8))
        ratio, inside = _ratio(pipelines, effort.size, light)
        before = linear_from_srgb(codes.rgb[inside] / 255.0)
        expected = before * ratio[inside]
        live = yuv_from_linear(np.repeat(picture[..., None], 3, axis=2))
        for method, mark in METHODS:
            scene = _scene(method)
            found = pipelines.of(codes).render(codes, scene, light=light).frame
            assert isinstance(found, RgbFrame)
            pipeline = pipelines.of(live)
            times = timed(partial(pipeline.render, live, scene, light=light), effort.repeats)
            errors = relative(linear_from_srgb(found.rgb[inside] / 255.0), expected)
            yield Row(STAGE, method, SCENE, errors, times, condition=f"exposure {exposure}", mark=mark)
        yield Row(STAGE, "no shadow", SCENE, relative(before, expected), condition=f"exposure {exposure}", mark="null")


def _tiles(size: tuple[int, int]) -> Array:
    """(height, width) albedo: tiles of a quarter of a metre on the ground, nothing above the horizon."""
    directions = pixel_directions(size[1], size[0])
    distance = -CAMERA_HEIGHT / np.minimum(directions[..., 1], -1e-2)
    x, z = (np.floor(directions[..., axis] * distance / 0.25).astype(int) for axis in (0, 2))
    return np.where(directions[..., 1] < -1e-2, np.array(ALBEDOS)[(x + 2 * z) % len(ALBEDOS)], 0.3)


def _light(exposure: float) -> FrameLight:
    """The irradiance under which the camera's picture, read by the papers' operator, is albedo times exposure: pi times its gain
    for dark greys, so that at exposure 1 the picture is the albedo."""
    whole = np.pi * OFFSET * exposure
    towards = direction(160, 50)
    sky = (1 - SUN_SHARE) * whole / np.pi
    light = Light(towards, np.full(3, SUN_SHARE * whole / towards[1]), np.radians(1.0), id=1)
    flat, coefficients = np.full((64, 128, 3), sky, np.float32), np.zeros((25, 3))
    coefficients[0] = sky * np.sqrt(4 * np.pi)
    return FrameLight(Detection((light,), flat, flat, 0.0), coefficients, flat, np.pi * flat)


def _scene(method: str) -> Scene:
    return Scene(camera_height=CAMERA_HEIGHT, objects=Scene.model_validate({"objects": [PLATE]}).objects,
                 lighting=Lighting(composite="additive" if method == "additive" else "ratio"))


def _ratio(pipelines: Pipelines, size: tuple[int, int], light: FrameLight) -> tuple[Array, NDArray[np.bool_]]:
    """(height, width, 3) what the ground keeps of its light by our own shadows, given as truth, and where that is less than all."""
    frame = RadianceFrame(np.ones((size[1], size[0], 3), np.float32))
    scene = _scene("ratio")
    found = pipelines.of(frame).render(frame, scene, light=light).frame
    assert isinstance(found, RadianceFrame)
    directions = pixel_directions(size[1], size[0])
    u, v = directions[..., 0] / -directions[..., 2], directions[..., 1] / -directions[..., 2]
    plate = (directions[..., 2] < 0) & (np.abs(u) < 0.32) & (v > -0.3)
    ratio = found.rgb.astype(np.float64)
    return ratio, (directions[..., 1] < -0.1) & ~plate & (ratio[..., 1] < 0.98)

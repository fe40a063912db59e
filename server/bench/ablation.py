"""Truth everywhere except in one stage: what share each stage has in the error of the whole.

A stage is fed with truth, and its output stands where it belongs in an otherwise true picture. What light detection finds
lights the float64 reference; a ball that the diffuse or the glossy stage shades under the true light, the ground with our
shadows under the true light, or with a shadow composited that is taken for true, is put into the true picture.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from renderer.color import linear_from_srgb
from renderer.frame import RadianceFrame
from renderer.light.detection import Detection
from renderer.light.diffuse import diffuse_map
from renderer.light.inverse_tone_mapping import linear_from_radiance
from renderer.light.irradiance import project
from renderer.light.reading import FrameLight
from renderer.light.specular import resample
from renderer.scene import PRESETS, Lighting
from server.bench.ball_reference import Environment
from server.bench.effort import Effort
from server.bench.pipelines import Pipelines
from server.bench.rows import Mark, Row
from server.bench.whole_rows import by_region, displayed, photographed, picture, rendered
from server.bench.whole_scene import Pixels, balls_scene, environment, looked_at, true_radiance
from server.bench.worlds import World, worlds

Array = NDArray[np.float64]
STAGE = "ablation"
MEASURE = ("the same pixels and units as of the whole: truth everywhere but in one stage. `share`: of the sum of the squares "
           "of all stages' errors. From the radiance map; `camera`: from its 8 bit picture")
REGION_OF = {"diffuse": "diffuse", "glossy": "glossy", "shadows": "ground"}
MARKS: tuple[Mark, ...] = ("default", "paper")


def ablation_rows(pipelines: Pipelines, effort: Effort) -> Iterator[Row]:
    pixels = looked_at(effort.size, effort.pixels)
    for world in worlds(effort.size, effort.whole_worlds):
        truth = true_radiance(environment(world.sky, world.lights, world.sky), pixels, _flat(world.radiance), effort.texels)
        for mark in MARKS:
            errors = _stages(pipelines, world, pixels, truth, mark, effort.texels)
            total = sum(float((one**2).mean()) for name, one in errors.items() if not name.endswith("camera"))
            for name, one in errors.items():
                share = None if name.endswith("camera") else float((one**2).mean()) / max(total, 1e-300)
                yield Row(STAGE, name, world.name, one, params=mark, mark=mark, extra={"share": share})
            preset = Lighting(preset="default" if mark == "default" else "paper")
            for given, name in (("radiance", "all"), ("camera", "all, camera")):
                expected = truth if given == "radiance" else displayed(truth, world)
                found = rendered(pipelines, world, preset, pixels, given)
                yield Row(STAGE, name, world.name, by_region(found, expected), params=mark, mark=mark, extra={"share": None})


def _stages(pipelines: Pipelines, world: World, pixels: Pixels, truth: dict[str, Array], mark: Mark,
            texels: int) -> dict[str, Array]:
    """Errors of the picture by the one stage that is not true."""
    methods = PRESETS[mark]
    errors = {"lights": _lights(pipelines, world, pixels, truth, methods["lights"], texels),
              "lights, camera": _lights_of_camera(pipelines, world, pixels, truth, methods["lights"], texels)}
    for stage, region in REGION_OF.items():
        drawn = _with_true_light(pipelines, world, Lighting.model_validate({stage: methods[stage]}))
        errors[stage] = by_region({**truth, region: drawn[pixels.indices[region]]}, truth)
    errors["composite"] = _composite(pipelines, world, pixels, truth, methods["composite"])
    errors["composite, camera"] = _composite_of_camera(pipelines, world, pixels, truth, methods["composite"])
    return errors


def _flat(radiance: NDArray[np.floating]) -> Array:
    return radiance.reshape(-1, 3).astype(np.float64)


def _lights(pipelines: Pipelines, world: World, pixels: Pixels, truth: dict[str, Array], method: str, texels: int) -> Array:
    found = pipelines.light(RadianceFrame(world.radiance), Lighting.model_validate({"lights": method})).detection
    lit = true_radiance(_found(found, world.sky), pixels, _flat(world.radiance), texels)
    return by_region(lit, truth)


def _lights_of_camera(pipelines: Pipelines, world: World, pixels: Pixels, truth: dict[str, Array], method: str,
                      texels: int) -> Array:
    """The light is in units of the tone curve; so is what it lights, until it is shown."""
    frame = picture(world)
    light = pipelines.light(frame, Lighting.model_validate({"lights": method}))
    ratio = true_radiance(_found(light.detection, light.detection.soft), pixels, np.ones((frame.rgb[..., 0].size, 3)), texels)
    shown = {region: np.minimum(linear_from_radiance(values), 1.0) for region, values in ratio.items()}
    before = _flat(world.shown)
    return by_region({**shown, "ground": before[pixels.indices["ground"]] * ratio["ground"]}, displayed(truth, world))


def _found(detection: Detection, backdrop: NDArray[np.floating]) -> Environment:
    lights = tuple(light for light in detection.lights if not light.is_wide)
    return environment(detection.soft, lights, backdrop)


def true_light(world: World, lighting: Lighting) -> FrameLight:
    """The light itself, its residual filtered by a method."""
    sky = np.asarray(resample(world.sky, 128, 256), dtype=np.float64)
    soft = np.asarray(resample(sky, 64, 128), dtype=np.float32)
    lights = tuple(replace(light, id=index + 1) for index, light in enumerate(world.lights))
    coefficients = project(soft)
    irradiance = diffuse_map(lighting.method("diffuse"), soft, coefficients)
    return FrameLight(Detection(lights, sky, sky, 0.0), coefficients, soft, irradiance)


def _with_true_light(pipelines: Pipelines, world: World, lighting: Lighting) -> Array:
    """(height * width, 3) radiance: no lights are in the frame itself, so that none is seen twice."""
    frame = RadianceFrame(world.sky.astype(np.float32))
    drawn = pipelines.of(frame).render(frame, balls_scene(lighting), light=true_light(world, lighting)).frame
    assert isinstance(drawn, RadianceFrame)
    return _flat(drawn.rgb)


def _composite(pipelines: Pipelines, world: World, pixels: Pixels, truth: dict[str, Array], method: str) -> Array:
    """The ground by a method, less the ground times our ratio, which is exact on a radiance map, for the same shadow."""
    indices = pixels.indices["ground"]
    found, ours = (_with_true_light(pipelines, world, Lighting.model_validate({"composite": one}))[indices]
                   for one in (method, "ratio"))
    return by_region({**truth, "ground": truth["ground"] + found - ours}, truth)


def _composite_of_camera(pipelines: Pipelines, world: World, pixels: Pixels, truth: dict[str, Array], method: str) -> Array:
    """The ground by a method, less the codes before times what our ratio is on a frame of ones."""
    indices = pixels.indices["ground"]
    lighting = Lighting.model_validate({"composite": method})
    found = photographed(pipelines, world, lighting)
    codes = picture(world)
    light = pipelines.light(codes)
    ones = RadianceFrame(np.ones_like(world.radiance))
    ratio = pipelines.of(ones).render(ones, balls_scene(), light=light).frame
    assert isinstance(ratio, RadianceFrame)
    before = _flat(linear_from_srgb(codes.rgb / 255.0))[indices]
    expected = displayed(truth, world)
    errors = _flat(found)[indices] - before * _flat(ratio.rgb)[indices]
    return by_region({**expected, "ground": expected["ground"] + errors}, expected)

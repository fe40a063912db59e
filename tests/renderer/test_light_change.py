"""A light that nobody can tell from the last one costs nothing; one that drifts is followed."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from renderer.frame import RadianceFrame
from renderer.gl import Context
from renderer.light.change import hardly_changed
from renderer.light.reading import FrameLight
from renderer.objects.shading import ShadingStage
from renderer.pipeline import Pipeline
from tests.renderer.frames import direction, scene, sky_with_sun

SIZE = (512, 256)
BALL = {"mesh": "sphere", "position": [0, -1.2, -2], "scale": [0.8, 0.8, 0.8],
        "material": {"base_color": [0.8] * 3, "roughness": 0.6}}


@pytest.fixture
def pipeline(context: Context) -> Any:
    pipeline = Pipeline(context, RadianceFrame, SIZE)
    yield pipeline
    pipeline.release()


def light_of(pipeline: Pipeline) -> FrameLight:
    return pipeline.render(sky_with_sun(30, 50, size=SIZE), scene(BALL)).light


def test_what_counts_as_a_change(pipeline: Pipeline) -> None:
    light = light_of(pipeline)
    sun = light.detection.lights[0]
    assert hardly_changed(light, replace(light))
    whole = float(light.irradiance.mean() + sun.irradiance.mean())
    for share, same in ((0.003, True), (0.006, False), (-0.006, False)):
        assert hardly_changed(light, replace(light, irradiance=light.irradiance + np.float32(share * whole))) == same
    brighter = replace(light.detection, lights=(replace(sun, irradiance=sun.irradiance * 1.02),))
    moved = replace(light.detection, lights=(replace(sun, direction=direction(30.6, 50)),))
    renamed = replace(light.detection, lights=(replace(sun, id=sun.id + 1),))
    gone = replace(light.detection, lights=())
    for detection in (brighter, moved, renamed, gone):
        assert not hardly_changed(light, replace(light, detection=detection))
    patch = light.soft.copy()
    patch[20:28, 20:28] *= 1.2
    assert not hardly_changed(light, replace(light, soft=patch))


def test_a_light_that_stays_is_not_shaded_again(pipeline: Pipeline, monkeypatch: pytest.MonkeyPatch) -> None:
    shaded: list[int] = []
    shade = ShadingStage._shade_one

    def counted(self: ShadingStage, *given: Any, **named: Any) -> None:
        shaded.append(1)
        shade(self, *given, **named)

    monkeypatch.setattr(ShadingStage, "_shade_one", counted)
    placed, frame = scene(BALL), sky_with_sun(30, 50, size=SIZE)
    random = np.random.default_rng(1)
    counts = []
    for _ in range(40):
        noisy = RadianceFrame((frame.rgb * random.normal(1, 0.03, frame.rgb.shape)).astype(np.float32))
        light, _ = pipeline.analyse(noisy)
        pipeline.render(noisy, placed, light=light)
        counts.append(len(shaded))
    assert counts[12] - counts[0] == 12
    assert counts[-1] == counts[-10]
    pipeline.render(frame, scene({**BALL, "position": [0.5, -1.2, -2]}), light=light)     # but what moves is
    assert len(shaded) > counts[-1]


def test_a_light_that_drifts_is_followed(pipeline: Pipeline, context: Context) -> None:
    placed, frame = scene(BALL), sky_with_sun(30, 50, size=SIZE)
    for step in range(80):
        darker = RadianceFrame(frame.rgb * np.float32(0.999**step))
        light, _ = pipeline.analyse(darker)
        rendered = pipeline.render(darker, placed, light=light)
    fresh = Pipeline(context, RadianceFrame, SIZE)
    expected = fresh.render(darker, placed, light=light)
    fresh.release()
    assert isinstance(rendered.frame, RadianceFrame)
    assert isinstance(expected.frame, RadianceFrame)
    ratio = rendered.frame.rgb / np.maximum(expected.frame.rgb, 1e-6)
    assert np.abs(ratio - 1)[100:200, 200:312].mean() < 0.004

"""The methods of the papers beside ours, chosen by the scene, in whole frames."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from renderer.equirectangular import pixel_directions, solid_angles
from renderer.frame import RadianceFrame, RgbFrame
from renderer.gl import Context
from renderer.light.diffuse import convolved, diffuse_map, diffuse_radiance_map, harmonic_map
from renderer.light.irradiance import basis, irradiance_order, project
from renderer.pipeline import Pipeline, Rendered
from renderer.scene import Lighting, Scene
from tests.renderer.frames import scene, sky_with_sun

SPHERES = [{"mesh": "sphere", "position": [x, -0.2, -2],
            "material": {"metallic": 1, "roughness": roughness, "base_color": [1, 1, 1]}}
           for x, roughness in ((-1.2, 0.3), (0.0, 0.6), (1.2, 1.0))]


def render(context: Context, frame: RadianceFrame, given: Scene) -> Rendered:
    pipeline = Pipeline(context, RadianceFrame, frame.size)
    rendered = pipeline.render(frame, given)
    pipeline.release()
    return rendered


@pytest.mark.parametrize("diffuse", ["auto", "sh", "convolution", "map16x8", "map32x16", "map128x64"])
@pytest.mark.parametrize("glossy", ["ggx", "rings36"])
def test_every_diffuse_and_glossy_method_is_a_furnace(context: Context, diffuse: str, glossy: str) -> None:
    frame = RadianceFrame(np.full((128, 256, 3), 2.0, np.float32))
    for metallic, roughness in ((1, 0.5), (0, 1.0)):
        material = {"metallic": metallic, "roughness": roughness, "base_color": [1, 1, 1]}
        given = scene({"mesh": "sphere", "position": [0, 0, -2], "material": material}, ground={"catcher": False},
                      lighting={"diffuse": diffuse, "glossy": glossy})
        rendered = render(context, frame, given).frame
        assert isinstance(rendered, RadianceFrame)
        assert np.abs(rendered.rgb / 2.0 - 1).max() < 0.02


@pytest.mark.parametrize("lights", ["default", "threshold", "probe"])
@pytest.mark.parametrize("glossy", ["ggx", "rings36"])
def test_every_light_method_lights_spheres_much_alike(context: Context, lights: str, glossy: str) -> None:
    frame = sky_with_sun(60, 45, sun=60.0, radius_deg=6)
    expected = render(context, frame, scene(*SPHERES)).frame
    rendered = render(context, frame, scene(*SPHERES, lighting={"lights": lights, "glossy": glossy}))
    assert isinstance(rendered.frame, RadianceFrame)
    assert isinstance(expected, RadianceFrame)
    assert rendered.light.method == lights
    assert rendered.light.detection.lights
    assert np.isfinite(rendered.frame.rgb).all()
    touched = (expected.rgb != frame.rgb).any(axis=2)
    assert rendered.frame.rgb[touched].mean() == pytest.approx(expected.rgb[touched].mean(), rel=0.25)
    assert (rendered.frame.rgb[touched] != expected.rgb[touched]).any() or (lights, glossy) == ("default", "ggx")


def test_rings_follow_the_frame_even_when_the_light_is_that_of_an_earlier_one(context: Context) -> None:
    dark, bright = (RgbFrame(np.full((128, 256, 3), code, dtype=np.uint8)) for code in (60, 160))
    given = scene(SPHERES[1], ground={"catcher": False}, lighting={"glossy": "rings36"})
    pipeline = Pipeline(context, RgbFrame, dark.size)
    light = pipeline.render(dark, given).light
    result = pipeline.render(bright, given, light=light).frame
    pipeline.release()
    assert isinstance(result, RgbFrame)
    assert result.rgb[68, 128, 0] == pytest.approx(160, abs=4)


def test_the_papers_diffuse_map_is_their_sum() -> None:
    """Algorithm 1 by direct summation, at every size."""
    radiance = np.random.default_rng(5).uniform(0, 4, (128, 256, 3))
    for rows in (8, 16, 64):
        blocks = radiance * solid_angles(128, 256)[..., None]
        small = blocks.reshape(rows, 128 // rows, 2 * rows, 128 // rows, 3).sum(axis=(1, 3))
        small /= solid_angles(rows, 2 * rows)[..., None]
        d = pixel_directions(rows, 2 * rows)
        latitude = np.sqrt(1 - d[..., 1] ** 2).ravel()
        picked = d.reshape(-1, 3)[:: max(1, rows * rows // 50)]
        weights = np.maximum(picked @ d.reshape(-1, 3).T, 0.0) * latitude
        expected = np.pi * (weights @ small.reshape(-1, 3)) / weights.sum(axis=1, keepdims=True)
        found = diffuse_radiance_map(radiance, rows).reshape(-1, 3)[:: max(1, rows * rows // 50)]
        assert found == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize(("bands", "order"), [((0,), 0), ((0, 1), 1), ((0, 2), 2), ((0, 1, 2), 2), ((0, 4), 4)])
def test_the_order_of_the_harmonics_is_the_lowest_that_does(bands: tuple[int, ...], order: int) -> None:
    coefficients = np.zeros((25, 3))
    for band in bands:
        coefficients[band**2] = 0.5
    assert irradiance_order(coefficients)[0] == order


def test_harmonics_stand_in_for_the_convolution_only_where_they_do_as_well() -> None:
    d = pixel_directions(64, 128)
    for radiance, suffices in ((1.0 + 0.5 * basis(d)[..., 5], True), ((d[..., 1] > 0.3) * 1.0, False)):
        rgb = np.repeat(radiance[..., None], 3, axis=2).astype(np.float32)
        coefficients = project(rgb)
        order, error = irradiance_order(coefficients)
        exact, found = convolved(rgb), diffuse_map("auto", rgb, coefficients)
        assert (error <= 0.0025) is suffices
        assert np.sqrt(((found - exact) ** 2).mean()) < 0.003 * np.sqrt((exact**2).mean())
        assert np.array_equal(found, harmonic_map(coefficients, order)) is suffices


@pytest.mark.parametrize("diffuse", ["map", "map8x4", "map256x128", "map32x32", "map32x15", "sph", ""])
def test_a_diffuse_map_of_another_size_is_refused_by_name(diffuse: str) -> None:
    with pytest.raises(ValidationError, match=r"expected auto, sh, convolution or mapWxH \(16x8 to 128x64"):
        Lighting(diffuse=diffuse)


def test_a_preset_is_its_methods_and_single_ones_can_be_others() -> None:
    assert [Lighting().method(stage) for stage in ("diffuse", "glossy", "lights")] == ["auto", "ggx", "default"]
    assert Lighting(lights="probe", diffuse="map64x32").method("lights") == "probe"
    assert Lighting(diffuse="map64x32").method("diffuse") == "map64x32"

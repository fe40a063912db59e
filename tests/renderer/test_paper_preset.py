"""MR360's shadow mapping and additive compositing (sections 6.3 and 6.4) beside ours, in whole frames."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from renderer.color import srgb_from_linear
from renderer.equirectangular import uv_from_direction
from renderer.frame import Frame, RadianceFrame, RgbFrame, YuvFrame
from renderer.gl import Context
from renderer.light.detection import Detection, Light
from renderer.light.inverse_tone_mapping import linear_from_radiance, radiance_from_linear
from renderer.light.irradiance import disc_cosine, irradiance
from renderer.light.reading import FrameLight
from renderer.pipeline import Pipeline, Rendered
from renderer.shadows.shadow_mapping import ShadowMapping, screen_space_occlusion, texel_size
from tests.renderer.frames import direction, scene, yuv_from_linear

UP = np.array([0.0, 1.0, 0.0])
SUN = direction(0, 35)
PLATE = {"mesh": "box", "position": [0, 0.4, -3], "scale": [1, 0.05, 1], "material": {"base_color": [0.1, 0.1, 0.1]}}
SHADOW = np.array([0.0, -1.6, -3.0]) + 2.0 / np.tan(np.radians(35)) * np.array([0, 0, 1])    # of the plate's middle


def light_of(angular_radius: float, sun: float = 2.0, sky: float = 0.5, towards: np.ndarray = SUN) -> FrameLight:
    """One light in a uniform sky."""
    detection = Detection((Light(towards, np.full(3, sun), angular_radius),), *(np.full((16, 32, 3), sky),) * 2, threshold=0.0)
    coefficients = np.zeros((25, 3))
    coefficients[0] = sky * np.sqrt(4 * np.pi)
    return FrameLight(detection, coefficients, np.full((16, 32, 3), sky, np.float32), np.full((16, 32, 3), np.pi * sky, np.float32))


def ground_irradiance(light: FrameLight) -> float:
    suns = light.detection.lights
    direct = sum(float(sun.irradiance[0] * disc_cosine(sun.direction @ UP, sun.angular_radius)) for sun in suns)
    return direct + float(irradiance(light.coefficients, UP)[0])


def ground_frame(level: float, size: tuple[int, int] = (1024, 512)) -> RadianceFrame:
    return RadianceFrame(np.full((size[1], size[0], 3), level, np.float32))


def draw(context: Context, frame: Frame, light: FrameLight, *objects: dict[str, Any],
         **lighting: str) -> Rendered:
    pipeline = Pipeline(context, type(frame), frame.size)
    try:
        return pipeline.render(frame, scene(*objects, lighting=lighting), light=light)
    finally:
        pipeline.release()
        context.collect()


def at(rgb: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Red at points on the ground."""
    height, width = rgb.shape[:2]
    uv = uv_from_direction(np.atleast_2d(points))
    return np.asarray(rgb[np.minimum((uv[:, 1] * height).astype(int), height - 1), (uv[:, 0] * width).astype(int) % width, 0])


def test_a_light_without_size_has_the_same_umbra_by_either_method(context: Context) -> None:
    """Madsen's overlays (section 4): radiance without the jth source over radiance with all of them."""
    light, frame = light_of(0.0), ground_frame(0.5)
    ratios = []
    for method in ("area", "pcf"):
        result = draw(context, frame, light, PLATE, shadows=method).frame
        assert isinstance(result, RadianceFrame)
        ratios.append(result.rgb / 0.5)
    expected = 1 - 2.0 * np.sin(np.radians(35)) / ground_irradiance(light)
    inside = SHADOW + np.array([[x, 0, z] for x in np.linspace(-0.35, 0.35, 9) for z in np.linspace(-0.3, 0.3, 9)])
    outside = SHADOW + np.array([[x, 0, 0] for x in (-0.7, -0.6, 0.6, 0.7)])
    for ratio in ratios:
        assert at(ratio, inside) == pytest.approx(expected, rel=3e-2)     # the plate hides a hundredth of the sky as well
        assert at(ratio, outside) == pytest.approx(1.0, abs=1.2e-2)
    line = SHADOW + np.linspace(-1, 1, 400)[:, None] * [1.0, 0.0, 0.0]
    area, filtered = ((1 - at(ratio, line)).mean() for ratio in ratios)
    assert filtered == pytest.approx(area, rel=0.04)      # what the filter blurs it neither adds nor takes away


def test_the_penumbra_follows_the_solid_angle_as_the_paper_has_it(context: Context) -> None:
    assert texel_size(0.01, 5) == texel_size(0.1, 5) == 2 * 20 / 2048
    assert texel_size(0.6, 5) == texel_size(3.0, 5) == 2 * 50 / 2048
    assert texel_size(0.35, 39) == pytest.approx(2 * 40 / 2048)       # D = 120 m, e = 2
    assert texel_size(0.35, 41) == pytest.approx(2 * 120 / 2048)
    assert texel_size(0.1, 1000) == 2 * 40 / 2048
    widths = []
    for solid_angle in (0.01, 0.6):
        radius = float(np.arccos(1 - solid_angle / (2 * np.pi)))
        light = light_of(radius, towards=direction(0, 60))
        plate = {**PLATE, "position": [0, 0.0, -0.924], "scale": [1.0, 0.02, 1.0]}     # its shadow is under the camera
        result = draw(context, ground_frame(0.5, (2048, 1024)), light, plate, shadows="pcf").frame
        assert isinstance(result, RadianceFrame)
        line = np.array([0.0, -1.6, 0.0]) + np.linspace(0.0, 1.2, 1200)[:, None] * [1.0, 0.0, 0.0]
        ratio = at(result.rgb, line)
        share = (ratio - ratio[0]) / (ratio[-1] - ratio[0])
        widths.append(np.count_nonzero((share > 0.1) & (share < 0.9)) * 0.001)
    for width, texel in zip(widths, (2 * 20 / 2048, 2 * 50 / 2048), strict=True):
        assert width == pytest.approx(0.8 * 5 * texel, rel=0.15)


def test_a_filtered_shadow_is_kept_while_nothing_moves(context: Context, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[Light] = []
    fill = ShadowMapping.fill

    def counted(self: ShadowMapping, *given: Any) -> None:
        drawn.append(given[-1])
        fill(self, *given)

    monkeypatch.setattr(ShadowMapping, "fill", counted)
    frame = ground_frame(0.5, (256, 128))
    pipeline = Pipeline(context, RadianceFrame, frame.size)
    given = scene(PLATE, lighting={"shadows": "pcf"})
    moved = scene({**PLATE, "position": [0.5, 0.4, -3]}, lighting={"shadows": "pcf"})
    for wanted, count in ((given, 1), (given, 1), (moved, 2), (scene(PLATE), 2), (given, 3)):
        pipeline.render(frame, wanted, light=light_of(0.1))
        assert len(drawn) == count
    pipeline.release()


def test_the_papers_contact_shadow_is_half_of_a_uniform_occlusion() -> None:
    coefficients = np.zeros((25, 3))
    coefficients[0] = 2.0 * np.sqrt(4 * np.pi)      # radiance 2 from everywhere
    assert screen_space_occlusion(coefficients)[0] * np.sqrt(1 / (4 * np.pi)) == pytest.approx([1.0] * 3)
    assert not screen_space_occlusion(coefficients)[1:].any()


@pytest.mark.parametrize("share", [1.0, 0.4, 2.0])
def test_additive_and_ratio_agree_where_the_ground_has_the_albedo_of_the_video(context: Context, share: float) -> None:
    """Otherwise they differ by (rho - rho') dE / pi; rho' is what a radiance map's pixel shows at exposure 1."""
    level = shown = 0.4
    albedo = shown * share
    wanted = np.pi * level / albedo         # the irradiance under which a ground of this albedo looks like that
    light = light_of(0.0, sun=wanted * 0.6 / np.sin(np.radians(35)), sky=wanted * 0.4 / np.pi)
    assert ground_irradiance(light) == pytest.approx(wanted, rel=1e-3)
    ratio, additive = (draw(context, ground_frame(level), light, PLATE, composite=method).frame for method in ("ratio", "additive"))
    assert isinstance(ratio, RadianceFrame)
    assert isinstance(additive, RadianceFrame)
    spot = SHADOW[None]
    missing = (1 - at(ratio.rgb, spot) / level) * wanted
    assert missing == pytest.approx(0.6 * wanted, rel=1.5e-2)
    expected = np.maximum(at(ratio.rgb, spot) + (albedo - shown) * missing / np.pi, 0.0)
    assert at(additive.rgb, spot) == pytest.approx(expected, abs=2e-3)
    if share == 1.0:
        assert np.abs(additive.rgb - ratio.rgb).max() < 2e-3


def test_additive_is_clamped_at_black_and_works_on_display_signals(context: Context) -> None:
    frame = RgbFrame(np.full((512, 1024, 3), 128, np.uint8))
    level = float(radiance_from_linear(((128 / 255 + 0.055) / 1.055) ** 2.4 * np.ones((1, 3)))[0, 0])
    shown = float(linear_from_radiance(np.full((1, 3), level))[0, 0])
    for sun in (1.0, 100.0):
        light = light_of(0.0, sun=sun)
        result = draw(context, frame, light, PLATE, composite="additive").frame
        assert isinstance(result, RgbFrame)
        radiance = max(level - shown * sun * np.sin(np.radians(35)) / np.pi, 0.0)
        code = 255 * float(srgb_from_linear(linear_from_radiance(np.full((1, 3), radiance)))[0, 0])
        assert at(result.rgb, SHADOW[None])[0] == pytest.approx(code, abs=1.5)
        planes = draw(context, yuv_from_linear(np.full((512, 1024, 3), shown)), light, PLATE, composite="additive").frame
        assert isinstance(planes, YuvFrame)
        assert at(planes.y[..., None], SHADOW[None])[0] == pytest.approx(16 + 219 / 255 * code, abs=1.5)


def test_without_our_additions_the_papers_objects_see_the_distant_frame_alone(context: Context) -> None:
    """A neighbour, the ground's plane and its shadows change nothing but what they cover."""
    frame = ground_frame(0.5)
    frame.rgb[:200] = 1.5
    ball = {"mesh": "sphere", "position": [0, -1.1, -3]}
    materials = ({"metallic": 1, "roughness": 0.4}, {"metallic": 1, "roughness": 0.0}, {"roughness": 1})
    wall = {"mesh": "box", "position": [1.3, -1.1, -3], "casts_shadow": False, "material": {"base_color": [1, 0, 0]}}
    centre = uv_from_direction(np.array([0, -1.1, -3.0]))
    x, y = int(centre[0] * 1024), int(centre[1] * 512)
    for item in ({**ball, "material": material} for material in materials):
        for preset, differs in (("paper", False), ("default", True)):
            alone, beside = (draw(context, frame, light_of(0.0, sun=0.0), *items, preset=preset).frame
                             for items in ((item,), (item, wall)))
            assert isinstance(alone, RadianceFrame)
            assert isinstance(beside, RadianceFrame)
            change = np.abs(alone.rgb - beside.rgb)[y - 15:y + 15, x - 20:x + 21].max()
            assert bool(change > 0.01) is differs, (item, preset, change)

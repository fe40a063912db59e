"""Whole frames: what is untouched, where shadows fall, seam and poles, hard input."""

from __future__ import annotations

import numpy as np
import pytest

from renderer.color import YuvFormat
from renderer.equirectangular import uv_from_direction
from renderer.frame import Frame, RadianceFrame, RgbFrame, YuvFrame
from renderer.gl import Context
from renderer.light.detection import Detection, Light
from renderer.light.reading import FrameLight
from renderer.pipeline import Pipeline, Rendered
from renderer.scene import Scene
from tests.renderer.frames import direction, noise_frame, scene, sky_with_sun, yuv_from_linear

SPHERE = {"mesh": "sphere", "material": {"base_color": [0.8, 0.1, 0.1], "roughness": 0.6}}


def render(context: Context, frame: Frame, wanted: Scene) -> Rendered:
    pipeline = Pipeline(context, type(frame), frame.size)
    try:
        return pipeline.render(frame, wanted)
    finally:
        pipeline.release()
        context.collect()


def radiance(rendered: Rendered) -> np.ndarray:
    assert isinstance(rendered.frame, RadianceFrame)
    return rendered.frame.rgb


@pytest.mark.parametrize("size", [(256, 128), (258, 130), (1922, 962), (64, 64), (2, 2)])
@pytest.mark.parametrize("layout", [YuvFormat("bt709", False), YuvFormat("bt601", True)])
def test_without_objects_the_output_is_the_input(context: Context, size: tuple[int, int], layout: YuvFormat) -> None:
    frame = noise_frame(size, layout=layout)
    result = render(context, frame, Scene()).frame
    assert isinstance(result, YuvFrame)
    assert all((a == b).all() for a, b in zip((result.y, result.u, result.v), (frame.y, frame.u, frame.v), strict=True))


@pytest.mark.parametrize("layout", [YuvFormat("bt709", False), YuvFormat("bt601", True)])
def test_pixels_that_nothing_touches_stay_bit_identical(context: Context, layout: YuvFormat) -> None:
    frame = noise_frame((512, 256), seed=3, layout=layout)
    wanted = scene({**SPHERE, "position": [0, 0.5, -3], "casts_shadow": False}, ground={"catcher": False})
    rendered = render(context, frame, wanted)
    result = rendered.frame
    assert isinstance(result, YuvFrame)
    v, u = np.mgrid[0:256, 0:512]
    uv = uv_from_direction(np.array([0, 0.5, -3]))
    away = np.hypot((u + 0.5) / 512 - uv[0], ((v + 0.5) / 256 - uv[1]) / 2) * 2 * np.pi > 0.22
    assert (result.y != frame.y)[~away].mean() > 0.5
    assert (result.y == frame.y)[away].all()
    assert (result.u == frame.u)[away[::2, ::2] & away[1::2, 1::2]].all()
    assert 0.0 < rendered.touched_fraction < 0.1


@pytest.mark.parametrize("azimuth", [40.0, 90.0, 140.0, -60.0])
def test_the_shadow_falls_opposite_the_light(context: Context, azimuth: float) -> None:
    frame = sky_with_sun(azimuth, 45)
    base = np.array([0.0, -1.6, -3.0])
    wanted = scene({"mesh": "cylinder", "position": [0, -1.35, -3], "scale": [0.1, 0.5, 0.1]})
    change = frame.rgb[..., 0] - radiance(render(context, frame, wanted))[..., 0]
    tip_direction = -direction(azimuth, 0)
    for distance, shaded in ((0.35, True), (0.8, False), (-0.4, False)):
        point = base + distance * tip_direction   # the shadow of 0.5 m at 45 degrees is 0.5 m long
        u, v = uv_from_direction(point) * (512, 256)
        found = change[int(v), int(u)]
        assert (found > 0.2) if shaded else (found < 0.05), (distance, found)


def test_a_shadow_keeps_the_ambient_light(context: Context) -> None:
    frame = sky_with_sun(0, 60, sky=1.0, sun=500.0)
    wanted = scene({"mesh": "box", "position": [0, 0.4, -3], "scale": [2, 0.05, 2]})  # a roof 2 m above the ground
    result = radiance(render(context, frame, wanted))
    ground = np.array([0.0, -1.6, -3.0]) - 2.0 / np.tan(np.radians(60)) * direction(0, 0)
    u, v = uv_from_direction(ground) * (512, 256)
    sun = np.pi * 499 * np.sin(np.radians(2.0)) ** 2 * np.sin(np.radians(60))
    expected = np.pi / (np.pi + sun)
    assert 0.6 * expected < result[int(v), int(u), 0] / frame.rgb[int(v), int(u), 0] < 1.05 * expected


@pytest.mark.parametrize("columns", [256, 100, 333])
def test_turning_the_world_turns_the_picture(context: Context, columns: int) -> None:
    """The same scene with camera, sun and object turned about the vertical: catches the seam."""
    angle = 2 * np.pi * columns / 512
    turned_position = [3 * np.sin(angle), -1.1, -3 * np.cos(angle)]
    plain = radiance(render(context, sky_with_sun(40, 35), scene({**SPHERE, "position": [0, -1.1, -3]})))
    turned = radiance(render(context, RadianceFrame(np.roll(sky_with_sun(40, 35).rgb, columns, axis=1)),
                             scene({**SPHERE, "position": turned_position})))
    error = np.abs(np.roll(plain, columns, axis=1) - turned)
    assert np.percentile(error[plain < 50], 99.5) < 0.02
    assert (error > 0.2).mean() < 0.002


@pytest.mark.parametrize("height", [2.0, -1.4])
def test_an_object_over_a_pole_is_a_disc_there(context: Context, height: float) -> None:
    frame = sky_with_sun(40, 35)
    wanted = scene({**SPHERE, "position": [0, height, 0], "scale": [0.8, 0.8, 0.8], "casts_shadow": False}, camera_height=5)
    result = radiance(render(context, frame, wanted))
    rows = np.abs(result - frame.rgb).max(axis=2) > 1e-3
    rows = rows if height > 0 else rows[::-1]
    half_angle = np.degrees(np.arcsin(0.4 / abs(height)))
    inside, outside = int((half_angle - 2) / 180 * 256), int((half_angle + 2) / 180 * 256)
    assert rows[:inside].all()
    assert not rows[outside:].any()


def test_a_wall_wider_than_a_view_has_no_holes(context: Context) -> None:
    frame = sky_with_sun(40, 60)
    wanted = scene({"mesh": "box", "position": [0, 0, -1], "scale": [6, 1, 0.2], "casts_shadow": False})
    changed = np.abs(radiance(render(context, frame, wanted)) - frame.rgb).max(axis=2) > 1e-3
    middle = changed[128]
    left, right = np.flatnonzero(middle)[[0, -1]]
    assert middle[left:right + 1].all()
    assert np.degrees(np.arctan2(3, 0.9)) / 180 * 256 == pytest.approx((right - left) / 2, abs=3)


def test_the_nearer_object_hides_the_farther(context: Context) -> None:
    frame = sky_with_sun(40, 60)
    near = {**SPHERE, "position": [0, 0, -2], "material": {"base_color": [0, 0, 0], "emissive": [5, 0, 0], "roughness": 1}}
    far = {**SPHERE, "position": [0, 0, -4], "scale": [3, 3, 3],
           "material": {"base_color": [0, 0, 0], "emissive": [0, 5, 0], "roughness": 1}}
    for order in ((near, far), (far, near)):
        pixel = radiance(render(context, frame, scene(*order)))[128, 256]
        assert pixel[0] > 4 > 1 > pixel[1]


def test_a_white_furnace_leaves_a_white_object_invisible(context: Context) -> None:
    frame = RadianceFrame(np.full((128, 256, 3), 2.0, np.float32))
    for roughness in (0.0, 0.3, 0.6, 1.0):
        wanted = scene({"mesh": "sphere", "position": [0, 0, -2], "casts_shadow": False,
                        "material": {"base_color": [1, 1, 1], "metallic": 1, "roughness": roughness}}, ground={"catcher": False})
        result = radiance(render(context, frame, wanted))
        assert np.abs(result / 2.0 - 1).max() < 0.002, roughness


def test_a_mirror_shows_the_codes_of_the_frame(context: Context) -> None:
    linear = np.broadcast_to(np.linspace(0.05, 0.95, 256)[:, None, None], (256, 512, 3))
    frame = yuv_from_linear(linear)
    # a flat mirror straight ahead sends the view from below the horizon to above it
    wanted = scene({"mesh": "box", "position": [0, 0, -2], "scale": [1, 1, 0.01], "casts_shadow": False,
                    "material": {"base_color": [1, 1, 1], "metallic": 1, "roughness": 0}}, ground={"catcher": False})
    result = render(context, frame, wanted).frame
    assert isinstance(result, YuvFrame)
    rows = np.arange(118, 139)  # a mirror facing the camera keeps the height: the same row seen behind the camera
    assert np.abs(result.y[rows, 256].astype(int) - frame.y[rows, 0].astype(int)).max() <= 1


@pytest.mark.parametrize("value", [0.0, 1e-30, np.nan, np.inf, -5.0, 1e30])
def test_hard_frames_give_finite_pictures(context: Context, value: float) -> None:
    frame = RadianceFrame(np.full((64, 128, 3), value, np.float32))
    wanted = scene({**SPHERE, "position": [0, -1.1, -3]}, {"mesh": "box", "position": [2, -1.1, -3], "material": {"metallic": 1}})
    rendered = render(context, frame, wanted)
    touched = radiance(rendered)[~(radiance(rendered) == frame.rgb).all(axis=2) & np.isfinite(frame.rgb).all(axis=2)]
    assert np.isfinite(touched).all()
    sphere = uv_from_direction(np.array([0, -1.1, -3])) * (128, 64)
    assert np.isfinite(radiance(rendered)[int(sphere[1]), int(sphere[0])]).all()   # whatever lies behind it
    assert rendered.light.detection.lights == ()
    assert np.isfinite(rendered.light.coefficients).all()


def test_one_hot_pixel_among_nan_is_one_light(context: Context) -> None:
    frame = sky_with_sun(0, 30, sky=0.5)
    frame.rgb[:, :20] = np.nan
    frame.rgb[60, 200] = 1e30
    lights = render(context, frame, Scene()).light.detection.lights
    assert len(lights) in (1, 2)
    assert all(np.isfinite(light.irradiance).all() for light in lights)


def test_objects_that_cannot_be_drawn_are_reported_and_lose_nothing(context: Context) -> None:
    frame = sky_with_sun(0, 30)
    wanted = scene({"mesh": "sphere"}, {"mesh": "box", "position": [0, -9, -3]}, {"mesh": "asset:gone", "position": [0, 0, -3]},
                   {**SPHERE, "position": [0, 0, -3]})
    rendered = render(context, frame, wanted)
    assert rendered.errors.keys() == {"o0", "o1", "o2"}
    assert "contains the camera" in rendered.errors["o0"]
    assert "below the ground" in rendered.errors["o1"]
    assert "asset" in rendered.errors["o2"]
    assert (radiance(rendered) != frame.rgb).any()


def test_png_and_radiance_frames_go_through_the_same_code(context: Context) -> None:
    codes = np.full((128, 256, 3), 120, np.uint8)
    rendered = render(context, RgbFrame(codes), scene({**SPHERE, "position": [0, -1.1, -3]}))
    assert isinstance(rendered.frame, RgbFrame)
    changed = (rendered.frame.rgb != codes).any(axis=2)
    assert 0.005 < changed.mean() < 0.3
    assert not changed[:40].any()


def test_a_frame_of_another_size_is_refused(context: Context) -> None:
    pipeline = Pipeline(context, YuvFrame, (256, 128))
    with pytest.raises(ValueError, match=r"frame is YuvFrame \(128, 64\), expected YuvFrame \(256, 128\)"):
        pipeline.render(noise_frame((128, 64)), Scene())
    pipeline.release()


@pytest.mark.parametrize("roughness", [0.4, 0.6, 0.85, 1.0])
def test_a_sky_of_lights_is_a_white_furnace_too(context: Context, roughness: float) -> None:
    """512 analytic lights, each as large as its part of the sphere, added up: as white as the same sky as a map."""
    count, slots = 512, 8
    height = 1 - 2 * (np.arange(count) + 0.5) / count
    azimuth = (np.arange(count) + 0.5) * np.pi * (3 - np.sqrt(5))
    around = np.sqrt(1 - height**2)
    directions = np.stack([around * np.cos(azimuth), height, around * np.sin(azimuth)], axis=1)
    irradiance, radius = np.full(3, 4 * np.pi / count), 2 * float(np.arcsin(np.sqrt(1 / count)))
    frame, black = RadianceFrame(np.zeros((128, 256, 3), np.float32)), np.zeros((64, 128, 3))
    wanted = scene({"mesh": "sphere", "position": [0, 0, -1.2],
                    "material": {"base_color": [1, 1, 1], "metallic": 1, "roughness": roughness}}, ground={"catcher": False})
    pipeline, total = Pipeline(context, RadianceFrame, frame.size), np.zeros((128, 256))
    for first in range(0, count, slots):
        lights = tuple(Light(directions[index], irradiance, radius, id=index) for index in range(first, first + slots))
        light = FrameLight(Detection(lights, black, black, 0.0), np.zeros((25, 3)), black.astype(np.float32),
                           np.zeros((32, 64, 3), np.float32))
        result = pipeline.render(frame, wanted, light=light).frame
        assert isinstance(result, RadianceFrame)
        total += result.rgb[..., 1]
    pipeline.release()
    row = total[64, 128:142]    # from the middle to N.V = 0.3
    assert row == pytest.approx(1.0, abs=0.015)

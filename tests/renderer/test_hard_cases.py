"""Frames on which light is hard to read, each with the answer that is expected (notes on rendering, hard cases)."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from renderer.color import YuvFormat
from renderer.equirectangular import pixel_directions, solid_angles
from renderer.frame import Frame, RadianceFrame, RgbFrame, YuvFrame
from renderer.gl import Context
from renderer.light.inverse_tone_mapping import MAX_RADIANCE, WEIGHTS
from renderer.light.irradiance import disc_cosine
from renderer.light.reading import FrameLight
from renderer.pipeline import Pipeline
from renderer.scene import Lighting
from tests.renderer.frames import noise_frame, sky_with_sun, yuv_from_linear
from tests.renderer.light_maps import HEIGHT, WIDTH, detect, direction, disc, radiance_map

METHODS = [Lighting(), Lighting(lights="threshold", diffuse="map32x16"), Lighting(lights="probe"), Lighting(diffuse="sh")]


@pytest.fixture
def read(context: Context) -> Iterator[Read]:
    reading = Read(context)
    yield reading
    reading.release()


class Read:
    """The light of a frame, each as the first one of its stream; pipelines are kept by kind and size."""

    def __init__(self, context: Context) -> None:
        self._context = context
        self._pipelines: dict[tuple[type[Frame], tuple[int, int]], Pipeline] = {}

    def pipeline(self, frame: Frame) -> Pipeline:
        key = (type(frame), frame.size)
        if key not in self._pipelines:
            self._pipelines[key] = Pipeline(self._context, *key)
        return self._pipelines[key]

    def __call__(self, frame: Frame, lighting: Lighting | None = None) -> FrameLight:
        self.pipeline(frame).reset()
        return self.pipeline(frame).analyse(frame, lighting=lighting)[0]

    def release(self) -> None:
        for pipeline in self._pipelines.values():
            pipeline.release()


def grey(value: float, size: tuple[int, int] = (256, 128)) -> RadianceFrame:
    return RadianceFrame(np.full((size[1], size[0], 3), value, dtype=np.float32))


def is_finite(light: FrameLight) -> bool:
    arrays = [light.coefficients, light.soft, light.irradiance, light.detection.residual]
    arrays += [np.concatenate([item.direction, item.irradiance, [item.angular_radius, item.gain]])
               for item in light.detection.lights]
    return all(np.isfinite(array).all() for array in arrays)


def irradiance_at(light: FrameLight, normal: np.ndarray) -> np.ndarray:
    """On one normal, from the nearest texel of the irradiance map, and the lights."""
    directions = pixel_directions(*light.irradiance.shape[:2]).reshape(-1, 3)
    found = light.irradiance.reshape(-1, 3)[int(np.argmax(directions @ normal))].astype(float)
    return found + sum((float(disc_cosine(item.direction @ normal, item.angular_radius)) * item.irradiance
                        for item in light.detection.lights if not item.is_wide), np.zeros(3))


@pytest.mark.parametrize("lighting", METHODS)
@pytest.mark.parametrize("value", [0.0, 1e-30, 1e-6, 0.5, 1.0, 11.8, MAX_RADIANCE])
def test_a_flat_frame_has_its_own_irradiance_and_no_lights(read: Read, value: float, lighting: Lighting) -> None:
    light = read(grey(value), lighting)
    assert light.detection.lights == ()
    assert is_finite(light)
    assert light.irradiance == pytest.approx(np.pi * value, rel=2e-4, abs=1e-20)


@pytest.mark.parametrize("code", [16, 235])
def test_black_and_white_video_have_no_lights(read: Read, code: int) -> None:
    planes = (np.full((128, 256), code, np.uint8), *(np.full((64, 128), 128, np.uint8),) * 2)
    light = read(YuvFrame(*planes))
    assert light.detection.lights == ()
    assert is_finite(light)
    assert (light.irradiance.max() < 1e-6) == (code == 16)


def test_grey_with_a_code_of_noise_has_no_lights_for_300_frames(read: Read) -> None:
    random, chroma = np.random.default_rng(8), np.full((64, 128), 128, np.uint8)
    frames = [YuvFrame((126 + random.integers(-1, 2, (128, 256))).astype(np.uint8), chroma, chroma) for _ in range(30)]
    pipeline = read.pipeline(frames[0])
    values = []
    for index in range(300):
        light, _ = pipeline.analyse(frames[index % 30], index / 30)
        assert light.detection.lights == ()
        values.append(float(light.irradiance.mean()))
    assert np.std(np.log(values)) < 0.005


@pytest.mark.parametrize(("azimuth", "elevation"), [(0, 30), (180, 30), (-100, 0.5), (30, 89.9), (30, -89.9)])
def test_one_pixel_of_1e5_is_a_light_of_its_clamped_power(read: Read, azimuth: float, elevation: float) -> None:
    frame = grey(0.3)
    d = pixel_directions(128, 256)
    row, column = np.unravel_index(np.argmax(d @ direction(azimuth, elevation)), (128, 256))
    frame.rgb[row, column] = 1e5
    light = read(frame)
    found, = light.detection.lights
    assert is_finite(light)
    assert np.degrees(np.arccos(min(1.0, found.direction @ d[row, column]))) < 0.25
    expected = MAX_RADIANCE * float(solid_angles(128, 256)[row, 0])
    assert found.irradiance == pytest.approx(expected, rel=0.005)
    facing = irradiance_at(light, d[row, column])
    assert facing == pytest.approx(expected + 0.3 * np.pi, rel=0.005)


@pytest.mark.parametrize("elevation", [0.0, 30.0, 88.0, 90.0, -60.0])
def test_a_sun_on_the_seam_is_the_sun_of_any_other_place(read: Read, elevation: float) -> None:
    lights = [read(sky_with_sun(azimuth, elevation, radius_deg=4)).detection.lights for azimuth in (180, 0.0)]
    assert [len(found) for found in lights] == [1, 1]
    assert lights[0][0].irradiance == pytest.approx(lights[1][0].irradiance, rel=1e-3)
    assert lights[0][0].direction[1] == pytest.approx(lights[1][0].direction[1], abs=1e-4)


def test_a_sun_half_below_the_horizon_of_a_dark_ground_is_one_light(read: Read) -> None:
    d = pixel_directions(256, 512)
    inside = (d @ direction(40, 0) > np.cos(np.radians(4))) & (d[..., 1] > 0)
    rgb = np.where(inside, 100.0, np.where(d[..., 1] > 0, 0.5, 0.05))
    found, = read(RadianceFrame(np.repeat(rgb[..., None], 3, axis=2).astype(np.float32))).detection.lights
    assert np.degrees(np.arccos(found.direction @ direction(40, 1.7))) < 0.5      # centre of a half disc: 4 a / (3 pi)


def test_fireflies_are_never_lights(read: Read) -> None:
    random, pipeline, lights = np.random.default_rng(9), read.pipeline(grey(0.3)), []
    for index in range(60):
        frame = sky_with_sun(0, 40, size=(256, 128), radius_deg=4)
        frame.rgb[random.integers(0, 128), random.integers(0, 256)] = 200.0
        lights.append(pipeline.analyse(frame, index / 30)[0].detection.lights)
    later = [light for found in lights[20:] for light in found]     # one that is in the first frame fades
    assert {light.id for light in later} == {1}
    sun = [light for light in later if light.direction @ direction(0, 40) > 0.99]
    assert len(sun) == 40
    assert np.std(np.log([float(light.irradiance @ WEIGHTS) for light in sun])) < 0.01


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, -5.0, 1e30])
@pytest.mark.parametrize("lighting", METHODS)
def test_what_is_no_light_is_removed_at_the_door(read: Read, value: float, lighting: Lighting) -> None:
    frame = grey(0.5)
    frame.rgb[::7, ::5] = value
    light = read(frame, lighting)
    assert is_finite(light)
    assert light.soft.max() <= MAX_RADIANCE
    assert light.soft.min() >= 0.0


@pytest.mark.parametrize("size", [(2, 2), (3, 2), (2, 16), (63, 31), (300, 77), (961, 480), (1922, 961), (1000, 998)])
def test_odd_sizes_are_read(read: Read, size: tuple[int, int]) -> None:
    light = read(RgbFrame(np.random.default_rng(10).integers(0, 256, (size[1], size[0], 3), dtype=np.uint8)))
    assert is_finite(light)


@pytest.mark.parametrize("layout", [YuvFormat(matrix, full) for matrix in ("bt601", "bt709") for full in (False, True)])
def test_a_frame_is_the_same_light_in_every_colour_format(read: Read, layout: YuvFormat) -> None:
    d = pixel_directions(128, 256)
    linear = 0.05 + 0.4 * np.stack([np.maximum(d[..., 0], 0), np.maximum(d[..., 1], 0), np.maximum(-d[..., 2], 0)], axis=-1)
    expected = read(yuv_from_linear(linear)).irradiance
    assert read(yuv_from_linear(linear, layout)).irradiance == pytest.approx(expected, rel=0.02)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1), lighting=st.sampled_from(METHODS))
def test_any_noise_is_finite_by_every_method(read: Read, seed: int, lighting: Lighting) -> None:
    assert is_finite(read(noise_frame((64, 32), seed), lighting))


@settings(max_examples=60, deadline=None)
@given(azimuth=st.floats(-180, 180), elevation=st.floats(-90, 90), radius=st.floats(1.5, 20), strength=st.floats(0.1, 20))
def test_lights_and_residual_are_the_map(azimuth: float, elevation: float, radius: float, strength: float) -> None:
    """In vector irradiance and, texel by texel, in power."""
    given_map = disc(azimuth, elevation, radius, 0.3 + strength * 0.3 / np.sin(np.radians(radius)) ** 2)
    found = detect(given_map)
    weights = solid_angles(HEIGHT, WIDTH)[..., None] * pixel_directions(HEIGHT, WIDTH)
    left = (((given_map.rgb - found.residual) @ WEIGHTS)[..., None] * weights).sum(axis=(0, 1))
    taken = sum((float(light.irradiance @ WEIGHTS) * light.direction for light in found.lights), np.zeros(3))
    assert np.linalg.norm(left - taken) < 1e-5 * float((given_map.rgb @ WEIGHTS * solid_angles(HEIGHT, WIDTH)).sum())
    assert (found.residual >= 0).all()
    assert (found.residual <= given_map.rgb + 1e-12).all()


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), columns=st.integers(0, WIDTH - 1), mirrored=st.booleans())
def test_a_turned_map_has_turned_lights(seed: int, columns: int, mirrored: bool) -> None:
    random = np.random.default_rng(seed)
    radiance = 0.2 + 0.1 * random.random((HEIGHT, WIDTH))
    for _ in range(3):
        place = direction(random.uniform(-180, 180), random.uniform(-60, 60))
        radiance += random.uniform(5, 80) * (pixel_directions(HEIGHT, WIDTH) @ place > np.cos(np.radians(random.uniform(2, 8))))
    turned = np.roll(radiance, columns, axis=1)[:, ::-1 if mirrored else 1]
    before, after = detect(radiance_map(radiance)), detect(radiance_map(turned))
    angle = 2 * np.pi * columns / WIDTH
    turn = np.array([[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], [np.sin(angle), 0, np.cos(angle)]])
    wanted = [turn @ light.direction * ((-1, 1, 1) if mirrored else (1, 1, 1)) for light in before.lights]
    assert len(before.lights) == len(after.lights)
    for light, expected in zip(before.lights, wanted, strict=True):
        nearest = max(after.lights, key=lambda other, expected=expected: float(other.direction @ expected))     # type: ignore[misc]
        assert np.degrees(np.arccos(min(1.0, float(nearest.direction @ expected)))) < 0.05
        assert nearest.irradiance == pytest.approx(light.irradiance, rel=1e-5)


def test_a_sphere_turned_by_a_right_angle_has_turned_lights(read: Read) -> None:
    """Pitch, resampled: what was ahead is overhead."""
    d = pixel_directions(256, 512)
    for azimuth, elevation in ((0, 0), (30, 10), (90, 5), (180, -40)):
        frames = [np.where(one @ direction(azimuth, elevation) > np.cos(np.radians(5)), 60.0, 0.4)
                  for one in (d, np.stack([d[..., 0], d[..., 2], -d[..., 1]], axis=-1))]
        plain, pitched = (read(RadianceFrame(np.repeat(rgb[..., None], 3, axis=2).astype(np.float32))).detection.lights
                          for rgb in frames)
        assert len(plain) == len(pitched) == 1
        x, y, z = plain[0].direction
        assert np.degrees(np.arccos(min(1.0, float(pitched[0].direction @ (x, -z, y))))) < 0.5

"""Frames on which light is hard to read, each with its expected answer. Tests run these cases, `mr360 bench` reports them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
from numpy.typing import NDArray

from renderer.color import YuvFormat
from renderer.equirectangular import pixel_directions, solid_angles
from renderer.frame import RadianceFrame, RgbFrame, YuvFrame
from renderer.light.inverse_tone_mapping import MAX_RADIANCE, WEIGHTS
from renderer.light.reading import FrameLight
from renderer.scene import Lighting
from server.bench.frames import direction, grey_frame, sky_with_sun, yuv_from_linear
from server.bench.light_reference import light_irradiance
from server.bench.pipelines import Pipelines

Array = NDArray[np.float64]
Case = Callable[[Pipelines], None]
METHODS = {"default": Lighting(), "threshold": Lighting(lights="threshold", diffuse="map32x16"), "probe": Lighting(lights="probe"),
           "sh": Lighting(diffuse="sh")}
SMALL = (256, 128)


class MissedError(AssertionError):
    """A case has not given what it must."""


def expect(is_so: bool | np.bool_, text: str) -> None:
    """Raises MissedError with that text unless it is so."""
    if not is_so:
        raise MissedError(text)


def nearly(found: NDArray[np.floating] | float, expected: NDArray[np.floating] | float, rel: float, what: str,
           least: float = 1e-12) -> None:
    """Raises MissedError unless all values agree within a share of what is expected, or within `least`."""
    found, expected = np.asarray(found, dtype=np.float64), np.asarray(expected, dtype=np.float64)
    worst = float(np.max(np.abs(found - expected) - np.maximum(rel * np.abs(expected), least)))
    expect(worst <= 0.0, f"{what}: {np.ravel(found)[:3]}, expected {np.ravel(expected)[:3]} within {rel:g}")


def light_cases() -> dict[str, Case]:
    """By name. Each raises MissedError when it is not met."""
    cases: dict[str, Case] = {}
    for method, lighting in METHODS.items():
        for value in (0.0, 1e-40, 1e-30, 1e-6, 0.5, 1.0, 11.8, MAX_RADIANCE):
            cases[f"flat frame of {value:g}, {method}"] = partial(_flat, value, lighting)
        for value in (np.nan, np.inf, -np.inf, -5.0, 1e30):
            cases[f"pixels of {value:g}, {method}"] = partial(_no_light, value, lighting)
    for code in (16, 235):
        cases[f"video all {'black' if code == 16 else 'white'}"] = partial(_flat_video, code)
    cases["grey with a code of noise, 300 frames"] = _grey_noise
    for azimuth, elevation in ((0, 30), (180, 30), (-100, 0.5), (30, 89.9), (30, -89.9)):
        cases[f"one pixel of 1e5 at {azimuth}°, {elevation}°"] = partial(_one_pixel, azimuth, elevation)
    for height in (0.0, 30.0, 88.0, 90.0, -60.0):
        cases[f"sun on the seam, {height:g}° high"] = partial(_on_the_seam, height)
    cases["sun half below the horizon"] = _half_below
    cases["fireflies"] = _fireflies
    for size in ((2, 2), (3, 2), (2, 16), (63, 31), (300, 77), (961, 480), (1922, 961), (1000, 998)):
        cases[f"odd size {size[0]}x{size[1]}"] = partial(_odd_size, size)
    for layout in (YuvFormat("bt601", False), YuvFormat("bt601", True), YuvFormat("bt709", False), YuvFormat("bt709", True)):
        cases[f"{layout.matrix}, {'full' if layout.full_range else 'limited'} range"] = partial(_colour_format, layout)
    return cases


def flat(value: float, size: tuple[int, int] = SMALL) -> RadianceFrame:
    return grey_frame(np.full((size[1], size[0]), value))


def is_finite(light: FrameLight) -> bool:
    arrays: list[NDArray[np.floating]] = [light.coefficients, light.soft, light.irradiance, light.detection.residual]
    arrays += [np.concatenate([item.direction, item.irradiance, [item.angular_radius, item.gain]])
               for item in light.detection.lights]
    return all(bool(np.isfinite(array).all()) for array in arrays)


def _no_lights(light: FrameLight) -> None:
    expect(light.detection.lights == (), f"{len(light.detection.lights)} lights, expected none")
    expect(is_finite(light), "light is not finite")


def _flat(value: float, lighting: Lighting, pipelines: Pipelines) -> None:
    light = pipelines.light(flat(value), lighting)
    _no_lights(light)
    nearly(light.irradiance, np.pi * value, 2e-4, "irradiance", least=1e-20)


def _flat_video(code: int, pipelines: Pipelines) -> None:
    light = pipelines.light(YuvFrame(np.full((128, 256), code, np.uint8), *(np.full((64, 128), 128, np.uint8),) * 2))
    _no_lights(light)
    expect((light.irradiance.max() < 1e-6) == (code == 16), f"irradiance up to {light.irradiance.max():g}")


def _grey_noise(pipelines: Pipelines) -> None:
    random, chroma = np.random.default_rng(8), np.full((64, 128), 128, np.uint8)
    frames = [YuvFrame((126 + random.integers(-1, 2, (128, 256))).astype(np.uint8), chroma, chroma) for _ in range(30)]
    pipeline, values = pipelines.of(frames[0]), []
    for index in range(300):
        light, _ = pipeline.analyse(frames[index % 30], index / 30)
        _no_lights(light)
        values.append(float(light.irradiance.mean()))
    expect(np.std(np.log(values)) < 0.005, f"irradiance varies by {np.std(np.log(values)):.4f}, expected less than 0.005")


def _one_pixel(azimuth: float, elevation: float, pipelines: Pipelines) -> None:
    frame, d = flat(0.3), pixel_directions(128, 256)
    row, column = np.unravel_index(np.argmax(d @ direction(azimuth, elevation)), (128, 256))
    frame.rgb[row, column] = 1e5
    light = pipelines.light(frame)
    expect(is_finite(light), "light is not finite")
    expect(len(light.detection.lights) == 1, f"{len(light.detection.lights)} lights, expected 1")
    found = light.detection.lights[0]
    angle = np.degrees(np.arccos(min(1.0, float(found.direction @ d[row, column]))))
    expect(angle < 0.25, f"{angle:.2f}° from the pixel, expected less than 0.25°")
    expected = MAX_RADIANCE * float(solid_angles(128, 256)[row, 0])
    nearly(found.irradiance, np.full(3, expected), 0.005, "the light's irradiance")
    nearly(light_irradiance(light, d[row, column][None]), np.full((1, 3), expected + 0.3 * np.pi), 0.005, "irradiance facing it")


def _on_the_seam(elevation: float, pipelines: Pipelines) -> None:
    lights = [pipelines.light(sky_with_sun(azimuth, elevation, radius_deg=4)).detection.lights for azimuth in (180, 0.0)]
    counts = [len(found) for found in lights]
    expect(counts == [1, 1], f"{counts} lights on the seam and ahead, expected one each")
    nearly(lights[0][0].irradiance, lights[1][0].irradiance, 1e-3, "irradiance")
    nearly(lights[0][0].direction[1], lights[1][0].direction[1], 0.0, "height", least=1e-4)


def _half_below(pipelines: Pipelines) -> None:
    d = pixel_directions(256, 512)
    inside = (d @ direction(40, 0) > np.cos(np.radians(4))) & (d[..., 1] > 0)
    lights = pipelines.light(grey_frame(np.where(inside, 100.0, np.where(d[..., 1] > 0, 0.5, 0.05)))).detection.lights
    expect(len(lights) == 1, f"{len(lights)} lights, expected 1")
    angle = np.degrees(np.arccos(float(lights[0].direction @ direction(40, 1.7))))   # the centre of a half disc: 4 a / (3 pi)
    expect(angle < 0.5, f"{angle:.2f}° from the half disc's centre, expected less than 0.5°")


def _fireflies(pipelines: Pipelines) -> None:
    random, pipeline, lights = np.random.default_rng(9), pipelines.of(flat(0.3)), []
    for index in range(60):
        frame = sky_with_sun(0, 40, size=SMALL, radius_deg=4)
        frame.rgb[random.integers(0, 128), random.integers(0, 256)] = 200.0
        lights.append(pipeline.analyse(frame, index / 30)[0].detection.lights)
    later = [light for found in lights[20:] for light in found]     # one that is in the first frame fades
    sun = [light for light in later if light.direction @ direction(0, 40) > 0.99]
    expect({light.id for light in later} == {sun[0].id} and len(sun) == 40, "a firefly is a light")
    jitter = float(np.std(np.log([float(light.irradiance @ WEIGHTS) for light in sun])))
    expect(jitter < 0.01, f"the sun's power varies by {jitter:.3f}, expected less than 0.01")


def _no_light(value: float, lighting: Lighting, pipelines: Pipelines) -> None:
    frame = flat(0.5)
    frame.rgb[::7, ::5] = value
    light = pipelines.light(frame, lighting)
    expect(is_finite(light), "light is not finite")
    expect(light.soft.max() <= MAX_RADIANCE and light.soft.min() >= 0.0, f"radiance {light.soft.min():g} to {light.soft.max():g}")


def _odd_size(size: tuple[int, int], pipelines: Pipelines) -> None:
    codes = np.random.default_rng(10).integers(0, 256, (size[1], size[0], 3), dtype=np.uint8)
    expect(is_finite(pipelines.light(RgbFrame(codes))), "light is not finite")


def _colour_format(layout: YuvFormat, pipelines: Pipelines) -> None:
    d = pixel_directions(128, 256)
    linear = 0.05 + 0.4 * np.stack([np.maximum(d[..., 0], 0), np.maximum(d[..., 1], 0), np.maximum(-d[..., 2], 0)], axis=-1)
    expected = pipelines.light(yuv_from_linear(linear)).irradiance
    nearly(pipelines.light(yuv_from_linear(linear, layout)).irradiance, expected, 0.02, "irradiance")


def outcomes(pipelines: Pipelines, cases: dict[str, Case]) -> Iterator[tuple[str, str | None]]:
    """Name of each case, and what it missed (None: nothing)."""
    for name, case in cases.items():
        try:
            case(pipelines)
        except MissedError as missed:
            yield name, str(missed)
        except Exception as error:      # whatever it is, the case is not met, and the next one is to be seen as well
            yield name, f"{type(error).__name__}: {error}"
        else:
            yield name, None

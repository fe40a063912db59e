"""Small lights in frames that are finer than the radiance map."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest

from renderer.equirectangular import pixel_directions, solid_angles
from renderer.frame import Frame, RadianceFrame
from renderer.gl import Context
from renderer.light.detection import MIN_ANGULAR_RADIUS, Light
from renderer.pipeline import Pipeline
from tests.renderer.frames import yuv_from_linear
from tests.renderer.light_maps import direction

PLACES = [(0, 20), (33, 50), (180, 30), (179.3, 5), (-179.9, -40), (10, 85), (120, 89.9), (77, 90), (-100, -88), (45, 0.2)]
WIDTH, HEIGHT = 1024, 512


@lru_cache(maxsize=4)
def covered(azimuth: float, elevation: float, radius: float) -> np.ndarray:
    """Share of each pixel that the disc covers, of its exact solid angle in all; angles in degrees."""
    angle = np.arccos(np.clip(pixel_directions(HEIGHT, WIDTH) @ direction(azimuth, elevation), -1, 1))
    share = np.clip((np.radians(radius) - angle) / (np.pi / HEIGHT) + 0.5, 0, 1)
    return np.asarray(share * 2 * np.pi * (1 - np.cos(np.radians(radius))) / (share * solid_angles(HEIGHT, WIDTH)).sum())


def the_light(context: Context, frame: Frame) -> Light:
    pipeline = Pipeline(context, type(frame), frame.size)
    found, = pipeline.analyse(frame)[0].detection.lights
    pipeline.release()
    return found


@pytest.mark.parametrize("radius", [0.25, 0.5, 1.0, 2.0, 4.0, 8.0])
def test_a_disc_has_its_direction_size_and_power_wherever_it_is(context: Context, radius: float) -> None:
    pipeline = Pipeline(context, RadianceFrame, (WIDTH, HEIGHT))
    for azimuth, elevation in PLACES:
        share = covered(azimuth, elevation, radius)
        value = min(0.3 / np.sin(np.radians(radius)) ** 2, 3e4)
        frame = RadianceFrame(np.repeat((0.3 + value * share)[..., None], 3, axis=2).astype(np.float32))
        pipeline.reset()
        found, = pipeline.analyse(frame)[0].detection.lights
        assert np.degrees(np.arccos(min(1.0, found.direction @ direction(azimuth, elevation)))) < 0.1
        allowed = 0.1 if radius > 0.5 else 0.15 if radius == 0.5 else 0.4     # a pixel is 0.35 degrees wide
        assert found.angular_radius == pytest.approx(max(np.radians(radius), MIN_ANGULAR_RADIUS), rel=allowed), (azimuth, elevation)
        power = 2 * np.pi * (1 - np.cos(np.radians(radius))) * value
        assert found.irradiance == pytest.approx(power, rel=0.01)
    pipeline.release()


@pytest.mark.parametrize(("azimuth", "elevation"), [place for place in PLACES if place[1] > 0])
def test_video_is_looked_at_as_closely(context: Context, azimuth: float, elevation: float) -> None:
    """A white disc in 4:2:0: what the camera clipped, which is a little less than what it covers."""
    share = covered(azimuth, elevation, 1.0)
    found = the_light(context, yuv_from_linear(np.repeat((0.05 + 0.95 * np.minimum(share, 1.0))[..., None], 3, axis=2)))
    assert np.degrees(np.arccos(min(1.0, found.direction @ direction(azimuth, elevation)))) < 0.1
    assert np.degrees(found.angular_radius) == pytest.approx(0.9, rel=0.1)

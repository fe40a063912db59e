"""The papers' light detection, as published: its formulas on maps with known lights, and where they break."""

from __future__ import annotations

import numpy as np
import pytest

from renderer.frame import RadianceFrame
from renderer.gl import Context
from renderer.light.detection import Light
from renderer.light.threshold_detection import box_blurred, detect_by_threshold, strongest
from renderer.pipeline import Pipeline
from renderer.scene import Lighting
from tests.renderer.frames import sky_with_sun
from tests.renderer.light_maps import direction

ROWS, COLUMNS = 150, 600


def upper_half(azimuth: float, elevation: float, radius: float, value: float, sky: float = 0.5) -> np.ndarray:
    theta = (np.arange(ROWS) + 0.5) / ROWS * np.pi / 2
    phi = ((np.arange(COLUMNS) + 0.5) / COLUMNS - 0.5) * 2 * np.pi
    d = np.stack(np.broadcast_arrays(np.sin(theta)[:, None] * np.sin(phi), np.cos(theta)[:, None],
                                     -np.sin(theta)[:, None] * np.cos(phi)), axis=-1)
    inside = d @ direction(azimuth, elevation) > np.cos(np.radians(radius))
    return np.repeat(np.where(inside, value, sky)[..., None], 3, axis=2).astype(np.float32)


def small_map(value: float = 0.5) -> np.ndarray:
    return np.full((128, 256, 3), value)


def test_a_disc_has_its_direction_and_what_exceeds_the_threshold() -> None:
    upper = upper_half(40, 35, 5, 60.0)
    found = detect_by_threshold(upper, small_map())
    assert len(found.lights) == 1
    light = found.lights[0]
    assert np.degrees(np.arccos(light.direction @ direction(40, 35))) < 0.5
    expected = 2 * np.pi * (1 - np.cos(np.radians(5))) * (60.0 - found.threshold)   # eq. 4
    assert light.irradiance == pytest.approx(expected, rel=0.03)
    assert np.degrees(light.angular_radius) == pytest.approx(5, rel=0.15)           # the blur adds a rim


def test_the_threshold_is_mean_plus_two_sigma_of_the_blurred_texels() -> None:
    upper = upper_half(0, 45, 10, 20.0)
    blurred = box_blurred(upper[..., 0]).astype(np.float64)
    found = detect_by_threshold(upper, small_map())
    assert found.threshold == pytest.approx(blurred.mean() + 2 * blurred.std(), rel=1e-5)
    assert detect_by_threshold(upper, small_map(), sigmas=1.0).threshold == pytest.approx(blurred.mean() + blurred.std(), rel=1e-5)


def test_the_box_blur_is_the_mean_of_nine() -> None:
    values = np.random.default_rng(3).uniform(0, 5, (20, 30)).astype(np.float32)
    assert box_blurred(values)[7, 11] == pytest.approx(values[6:9, 10:13].mean(), rel=1e-5)
    assert box_blurred(values).shape == values.shape


def test_the_strongest_that_make_up_nine_tenths_are_kept() -> None:
    def lights(*powers: float) -> list[Light]:
        return [Light(np.array([0.0, 1.0, 0.0]), np.full(3, power), 0.1) for power in powers]

    assert [float(item.irradiance[0]) for item in strongest(lights(1, 60, 30, 9))] == [60, 30]
    assert len(strongest(lights(25, 25, 25, 25))) == 4
    assert strongest([]) == []


def test_the_map_is_clamped_to_the_threshold_in_its_own_colour() -> None:
    given = small_map()
    given[40, 50] = (40.0, 20.0, 10.0)
    found = detect_by_threshold(upper_half(40, 35, 5, 60.0), given)
    assert found.residual[40, 50] @ (0.3, 0.59, 0.11) == pytest.approx(found.threshold)
    assert found.residual[40, 50] / found.residual[40, 50, 2] == pytest.approx([4, 2, 1])
    assert (found.residual[0] == 0.5).all()


def test_it_breaks_at_the_seam_where_ours_does_not(context: Context) -> None:
    """Why it is only a baseline: a sun across the seam is two lights, or one in a wrong place."""
    frame = sky_with_sun(180, 40, radius_deg=4)
    pipeline = Pipeline(context, RadianceFrame, frame.size)
    theirs = pipeline.analyse(frame, lighting=Lighting(lights="threshold"))[0]
    ours = pipeline.analyse(frame)[0]
    pipeline.release()
    assert (theirs.method, ours.method) == ("threshold", "default")
    assert len(theirs.detection.lights) == 2
    assert len(ours.detection.lights) == 1


@pytest.mark.parametrize("value", [0.0, 0.5, 11.8])
def test_a_flat_frame_has_no_lights(value: float) -> None:
    found = detect_by_threshold(np.full((ROWS, COLUMNS, 3), value, dtype=np.float32), small_map(value))
    assert found.lights == ()
    assert np.isfinite(found.residual).all()

"""The sun in a clipped clear sky: found where it stands, and only where it is."""

from __future__ import annotations

import numpy as np
import pytest

from renderer.equirectangular import pixel_directions, solid_angles
from renderer.light.inverse_tone_mapping import WEIGHTS, radiance_from_linear
from renderer.light.radiance_map import RadianceMap
from renderer.light.sun import DIRECT_TO_SKY, NO_SKY, SunFinder, sun_in
from tests.renderer.light_maps import HEIGHT, WIDTH, direction

BLUE_SKY, RED_SKY, GREY_SKY = (0.08, 0.2, 0.5), (0.5, 0.3, 0.2), (0.4, 0.4, 0.4)
AUREOLE = (0.6, 0.85, 1.0)


def sky(azimuth: float, elevation: float, *, far: tuple[float, ...] = BLUE_SKY, glow: tuple[float, ...] = AUREOLE,
        exposure: float = 1.0) -> RadianceMap:
    """A clear sky over dark ground, with an aureole that falls off as a power of the angle, clipped at white."""
    d = pixel_directions(HEIGHT, WIDTH)
    angle = np.arccos(np.clip(d @ direction(azimuth, elevation), -1, 1))
    linear = 0.35 * (angle[..., None] + 0.02) ** -1.3 * np.array(glow) * 0.6 + np.array(far)
    linear = np.where(d[..., 1:2] > 0, linear, 0.1) * exposure
    shown = np.clip(linear, 0, 1)
    return RadianceMap(radiance_from_linear(shown), (shown @ WEIGHTS > 0.985).astype(float))


@pytest.mark.parametrize("elevation", [25.0, 45.0, 70.0])
@pytest.mark.parametrize("azimuth", [0.0, 36.3, 179.5, -110.0])
def test_the_sun_is_found_where_it_stands(azimuth: float, elevation: float) -> None:
    for exposure in (0.8, 1.2):
        found = SunFinder().look(sky(azimuth, elevation, exposure=exposure))
        assert found.score > 0.9
        assert found.direction is not None
        assert np.degrees(np.arccos(found.direction @ direction(azimuth, elevation))) < 0.5


def test_its_power_is_a_multiple_of_what_the_sky_gives_the_ground() -> None:
    given = sky(20, 50)
    sun = sun_in(SunFinder().look(given), given)
    assert sun is not None
    upward = np.maximum(pixel_directions(HEIGHT, WIDTH)[..., 1], 0.0) * solid_angles(HEIGHT, WIDTH)
    on_the_ground = float((given.rgb @ WEIGHTS * upward).sum())
    # the ground of this sky is even, as under a weak sun; with shadows as dark as a strong one makes them, it is strong
    assert sun.irradiance == pytest.approx(DIRECT_TO_SKY[0] * on_the_ground, rel=0.1)
    shaded = RadianceMap(np.where(pixel_directions(HEIGHT, WIDTH)[..., :1] > 0.7, given.rgb * 0.1, given.rgb), given.clipped)
    shaded.rgb[:HEIGHT // 2] = given.rgb[:HEIGHT // 2]
    sun = sun_in(SunFinder().look(shaded), given)
    assert sun is not None
    assert sun.irradiance == pytest.approx(DIRECT_TO_SKY[1] * on_the_ground, rel=0.1)


@pytest.mark.parametrize(("far", "glow"), [(GREY_SKY, (1, 1, 1)), (RED_SKY, (1, 0.8, 0.6)), (BLUE_SKY, (1.0, 0.75, 0.6))])
def test_under_cloud_and_after_sunset_there_is_none(far: tuple[float, ...], glow: tuple[float, ...]) -> None:
    given = sky(20, 30, far=far, glow=glow)
    assert given.clipped.any()
    found = SunFinder().look(given)
    assert found.score < 0.1


@pytest.mark.parametrize("value", [0.0, 0.5, 1.0])
def test_a_flat_frame_has_no_sun(value: float) -> None:
    flat = np.full((HEIGHT, WIDTH, 3), value)
    found = SunFinder().look(RadianceMap(radiance_from_linear(flat), np.full((HEIGHT, WIDTH), float(value >= 1))))
    assert found.direction is None
    assert sun_in(found, RadianceMap(flat, np.zeros((HEIGHT, WIDTH)))) is None


@pytest.mark.parametrize("size", [(1, 1), (2, 4), (7, 13), (64, 128)])
def test_any_size_is_looked_at(size: tuple[int, int]) -> None:
    rng = np.random.default_rng(7)
    given = RadianceMap(rng.uniform(0, 11.8, (*size, 3)), rng.uniform(0, 1, size))
    found = SunFinder().look(given)
    assert 0.0 <= found.score <= 1.0


def test_it_is_followed_from_the_last_frame_and_forgotten_at_a_cut() -> None:
    finder = SunFinder()
    for azimuth in np.arange(0.0, 30.0, 0.75):      # 22 degrees a second
        found = finder.look(sky(azimuth, 40))
        assert found.direction is not None
        assert np.degrees(np.arccos(found.direction @ direction(azimuth, 40))) < 0.5
    finder.reset()
    again = finder.look(sky(-120, 40)).direction
    assert again is not None
    assert np.degrees(np.arccos(again @ direction(-120, 40))) < 0.5


def test_a_frame_without_clipped_sky_is_left_alone() -> None:
    given = sky(0, 40)
    assert SunFinder().look(RadianceMap(given.rgb, np.zeros((HEIGHT, WIDTH)))) is NO_SKY

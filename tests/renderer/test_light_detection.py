"""Light detection against maps with known lights."""

from __future__ import annotations

import numpy as np
import pytest

from renderer.equirectangular import pixel_directions, solid_angles
from renderer.light.highlights import HighlightRestorer
from renderer.light.inverse_tone_mapping import WEIGHTS
from renderer.light.radiance_map import RadianceMap
from renderer.light.sources import label_components
from tests.renderer.light_maps import HEIGHT, WIDTH, detect, direction, disc, radiance_map

PLACES = [(0, 20), (33, 50), (180, 30), (179.3, 5), (-179.9, -40), (10, 85), (120, 89.9), (77, 90), (-100, -88), (45, 0.2)]


@pytest.mark.parametrize("radius", [2.0, 4.0, 8.0, 12.0, 16.0, 20.0])
@pytest.mark.parametrize("strength", [0.1, 1.0, 10.0])
def test_a_disc_is_one_light_where_it_is(radius: float, strength: float) -> None:
    """Anywhere, seam and poles included; `strength` is its irradiance against that of a grey sky all around."""
    for azimuth, elevation in PLACES:
        value = 0.3 + strength * 0.3 / np.sin(np.radians(radius)) ** 2
        found = detect(disc(azimuth, elevation, radius, value)).lights
        assert len(found) == 1, (azimuth, elevation)
        assert np.degrees(np.arccos(min(1.0, found[0].direction @ direction(azimuth, elevation)))) < 0.25
        assert np.degrees(found[0].angular_radius) == pytest.approx(radius, rel=0.12 if radius < 4 else 0.03)
        assert found[0].irradiance == pytest.approx(strength * 0.3 * np.pi, rel=0.01)


@pytest.mark.parametrize("radius", [0.25, 0.5, 1.0])
def test_a_disc_smaller_than_a_texel_has_its_power_and_place(radius: float) -> None:
    texel = 180 / HEIGHT
    for azimuth, elevation in PLACES:
        found = detect(disc(azimuth, elevation, radius, 0.3 + 0.3 / np.sin(np.radians(radius)) ** 2)).lights
        assert len(found) == 1, (azimuth, elevation)
        assert np.degrees(np.arccos(min(1.0, found[0].direction @ direction(azimuth, elevation)))) < texel / 2
        assert found[0].irradiance == pytest.approx(0.3 * np.pi, rel=0.01)


@pytest.mark.parametrize("columns", [1, 17, 100, 128, 255])
def test_a_rolled_map_has_rolled_lights(columns: int) -> None:
    given = disc(33, 50, 3.0).rgb[..., 0] + disc(-120, 20, 6.0, 60.0, sky=0.0).rgb[..., 0]
    before, after = (detect(radiance_map(np.roll(given, shift, axis=1))) for shift in (0, columns))
    angle = 2 * np.pi * columns / WIDTH
    turn = np.array([[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], [np.sin(angle), 0, np.cos(angle)]])
    assert len(before.lights) == len(after.lights) == 2
    for a, b in zip(before.lights, after.lights, strict=True):
        assert b.direction == pytest.approx(turn @ a.direction, abs=1e-6)
        assert b.irradiance == pytest.approx(a.irradiance, rel=1e-9)
    assert after.residual == pytest.approx(np.roll(before.residual, columns, axis=1), abs=1e-9)


def test_a_long_lamp_is_several_lights_along_it() -> None:
    d = pixel_directions(HEIGHT, WIDTH)
    tube = (np.abs(np.arcsin(d[..., 1]) - 0.9) < 0.03) & (np.abs(np.arctan2(d[..., 0], -d[..., 2])) < 0.5)
    found = detect(radiance_map(np.where(tube, 60.0, 0.3)))
    assert 2 <= len(found.lights) <= 4
    power = float((np.where(tube, 59.7, 0.0) * solid_angles(HEIGHT, WIDTH)).sum())
    assert sum(float(light.irradiance[0]) for light in found.lights) == pytest.approx(power, rel=0.02)
    assert max(light.angular_radius for light in found.lights) < np.radians(12)


def test_a_light_on_the_pole_is_one_light() -> None:
    found = detect(disc(0, 90, radius=4.0)).lights
    assert len(found) == 1
    assert found[0].direction[1] > np.cos(np.radians(0.25))


def test_one_pixel_on_the_seam_is_one_light() -> None:
    radiance = np.full((HEIGHT, WIDTH), 0.3)
    radiance[50, 0] = radiance[50, -1] = 1e4
    found = detect(radiance_map(radiance)).lights
    assert len(found) == 1
    assert found[0].direction == pytest.approx(direction(180, 90 - 180 * 50.5 / HEIGHT), abs=1e-4)


def test_residual_and_lights_add_up_to_the_map() -> None:
    given = disc(20, 30, radius=3.0)
    found = detect(given)
    weights = solid_angles(HEIGHT, WIDTH)[..., None]
    removed = ((given.rgb - found.residual) * weights).sum(axis=(0, 1))
    vectors = ((given.rgb - found.residual) * weights)[..., 0][..., None] * pixel_directions(HEIGHT, WIDTH)
    assert np.linalg.norm(vectors.sum(axis=(0, 1))) == pytest.approx(found.lights[0].irradiance[0], rel=1e-9)
    assert removed[0] == pytest.approx(found.lights[0].irradiance[0], rel=0.01)


@pytest.mark.parametrize("radiance", [0.0, 0.5, 11.8])
def test_a_flat_map_has_no_lights(radiance: float) -> None:
    noise = np.random.default_rng(0).uniform(-0.002, 0.002, (HEIGHT, WIDTH)) if radiance == 0.5 else 0.0
    found = detect(radiance_map(np.full((HEIGHT, WIDTH), radiance) + noise))
    assert found.lights == ()
    assert np.isfinite(found.residual).all()


def test_a_clipped_sun_is_restored_and_a_clipped_reflection_is_not() -> None:
    for elevation, restored in ((35, True), (-35, False)):
        given = disc(0, elevation, radius=2.0, value=11.8, sky=0.8)
        clipped = RadianceMap(given.rgb, (given.rgb[..., 0] - 0.8) / 11.0)
        found = [light for light in detect(HighlightRestorer().restore(clipped, 1.0)).lights if light.gain > 1.0]
        assert bool(found) is restored
        if restored:
            mean = float((clipped.rgb @ WEIGHTS * solid_angles(HEIGHT, WIDTH)).sum()) / 4
            assert 0.5 < found[0].irradiance @ WEIGHTS / mean < 1.5


def test_components_connect_across_seam_and_pole_diagonally() -> None:
    mask = np.zeros((8, 16), dtype=bool)
    mask[3, 0] = mask[4, 15] = True         # diagonal over the seam
    mask[0, 2] = mask[0, 9] = True          # both touch the pole
    labels, count = label_components(mask)
    assert count == 2
    assert labels[3, 0] == labels[4, 15] != labels[0, 2] == labels[0, 9]

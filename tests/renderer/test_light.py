"""The light stages against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from renderer.equirectangular import pixel_directions, solid_angles
from renderer.inverse_tone_mapping import WEIGHTS
from renderer.irradiance import BAND, COSINE_LOBE, basis, irradiance, project
from renderer.light_detection import detect, label_components
from renderer.light_tracking import LightTracker
from renderer.radiance_map import RadianceMap
from renderer.specular import dfg_table, ggx_lobe, map_rows, prefilter, resample
from tests.renderer.frames import direction

HEIGHT, WIDTH = 128, 256


def radiance_map(radiance: np.ndarray) -> RadianceMap:
    return RadianceMap(np.broadcast_to(radiance[..., None], (*radiance.shape, 3)).astype(np.float64), np.zeros(radiance.shape))


def disc(azimuth: float, elevation: float, radius: float, value: float = 200.0, sky: float = 0.3) -> RadianceMap:
    """A disc with soft, area-true edges: each texel by 8 x 8 samples."""
    fine = pixel_directions(HEIGHT * 8, WIDTH * 8) @ direction(azimuth, elevation) > np.cos(np.radians(radius))
    share = fine.reshape(HEIGHT, 8, WIDTH, 8).mean(axis=(1, 3))
    return radiance_map(sky + (value - sky) * share)


def normals(count: int = 500) -> np.ndarray:
    points = np.random.default_rng(1).normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def test_the_basis_is_orthonormal() -> None:
    b = basis(pixel_directions(512, 1024)).reshape(-1, 25)
    weights = np.broadcast_to(solid_angles(512, 1024), (512, 1024)).reshape(-1, 1)
    assert np.abs(b.T @ (b * weights) - np.eye(25)).max() < 1e-5


def test_a_constant_map_gives_pi_times_its_radiance() -> None:
    found = irradiance(project(np.full((HEIGHT, WIDTH, 3), 0.7)), normals())
    assert found == pytest.approx(0.7 * np.pi, rel=1e-4)


def test_a_cosine_lobe_gives_two_thirds_pi() -> None:
    lobe = np.maximum(pixel_directions(HEIGHT, WIDTH)[..., 1], 0)
    found = irradiance(project(np.repeat(lobe[..., None], 3, axis=2)), np.array([0, 1.0, 0]))
    assert found == pytest.approx(2 * np.pi / 3, rel=0.01)


@pytest.mark.parametrize("index", range(25))
def test_a_single_harmonic_gives_its_band_factor(index: int) -> None:
    harmonic = basis(pixel_directions(HEIGHT, WIDTH))[..., index]
    found = irradiance(project(np.repeat(harmonic[..., None], 3, axis=2)), normals())[:, 0]
    assert found == pytest.approx(COSINE_LOBE[index] * basis(normals())[:, index], abs=2e-3)
    assert BAND[index] == int(np.sqrt(index))


@pytest.mark.parametrize("azimuth", [0, 33, 90, 179.9, -180, -90])
@pytest.mark.parametrize("elevation", [5, 40, 88])
def test_a_disc_is_one_light_where_it_is(azimuth: float, elevation: float) -> None:
    found = detect(disc(azimuth, elevation, radius=4.0)).lights
    assert len(found) == 1
    assert np.degrees(np.arccos(found[0].direction @ direction(azimuth, elevation))) < 0.25
    assert np.degrees(found[0].angular_radius) == pytest.approx(4.0, rel=0.15)
    expected = np.pi * 199.7 * np.sin(np.radians(4.0)) ** 2
    assert found[0].irradiance == pytest.approx(expected, rel=0.1)


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
        found = [light for light in detect(clipped).lights if light.gain > 1.0]
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


def test_a_light_keeps_its_id_while_it_moves() -> None:
    tracker = LightTracker()
    ids = [tracker.update(detect(disc(azimuth, 30, 3.0)).lights)[0].id for azimuth in range(170, 192, 2)]
    assert set(ids) == {ids[0]}
    assert tracker.update(detect(disc(20, 30, 3.0)).lights)[0].id != ids[0]


@pytest.mark.parametrize("roughness", [0.2, 0.35, 0.5, 0.8, 1.0])
def test_prefiltering_keeps_a_constant_and_matches_quadrature(roughness: float) -> None:
    assert prefilter(np.full((HEIGHT, WIDTH, 3), 2.0), roughness) == pytest.approx(2.0, rel=1e-5)
    d = pixel_directions(HEIGHT, WIDTH)
    radiance = 1.0 + 0.8 * np.sin(3 * d[..., 0]) * np.cos(2 * d[..., 1]) + 0.5 * (d[..., 2] > 0.3)
    found = prefilter(np.repeat(radiance[..., None], 3, axis=2), roughness)[..., 0]
    rows = map_rows(roughness)
    out = pixel_directions(rows, 2 * rows).reshape(-1, 3)[:: max(1, rows * rows // 150)]
    weights = ggx_lobe(np.clip(out @ d.reshape(-1, 3).T, -1, 1), roughness) * np.broadcast_to(
        solid_angles(HEIGHT, WIDTH), (HEIGHT, WIDTH)).ravel()
    expected = (weights @ radiance.ravel()) / weights.sum(axis=1)
    error = found.ravel()[:: max(1, rows * rows // 150)] - expected
    assert np.sqrt((error**2).mean()) / np.sqrt((expected**2).mean()) < 0.02


def test_resampling_keeps_power() -> None:
    radiance = np.random.default_rng(2).uniform(0, 5, (120, 240, 3))
    power = (radiance * solid_angles(120, 240)[..., None]).sum(axis=(0, 1))
    for rows in (16, 32, 64):
        small = resample(radiance, rows, 2 * rows)
        assert (small * solid_angles(rows, 2 * rows)[..., None]).sum(axis=(0, 1)) == pytest.approx(power, rel=1e-9)


def test_the_split_sum_loses_energy_only_where_one_bounce_does() -> None:
    total = dfg_table().sum(axis=-1)
    assert total.max() <= 1.002
    assert total[2, -1] == pytest.approx(1.0, abs=0.01)            # smooth: everything comes back
    assert total[-1, -1] == pytest.approx(1 - np.log(2), abs=0.01)  # alpha = 1 seen from above, closed form

"""The light stages against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from renderer.equirectangular import pixel_directions, solid_angles
from renderer.light.diffuse import IRRADIANCE_ROWS, convolved
from renderer.light.irradiance import BAND, COSINE_LOBE, basis, irradiance, project
from renderer.light.specular import dfg_table, ggx_lobe, map_rows, prefilter, resample
from tests.renderer.light_maps import HEIGHT, WIDTH, direction


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


@pytest.mark.parametrize("size", [(1, 1), (3, 5), (16, 32), (45, 90), (64, 128), (120, 240)])
def test_the_irradiance_map_of_a_constant_is_pi_times_it(size: tuple[int, int]) -> None:
    assert convolved(np.full((*size, 3), 0.7)) == pytest.approx(0.7 * np.pi, rel=1e-5)


@pytest.mark.parametrize("azimuth", [0.0, 33.0, 180.0, -90.0])
def test_the_irradiance_map_is_that_of_direct_summation(azimuth: float) -> None:
    """Of half a sky and a window, anywhere: nothing is lost at the seam, and nothing is shifted."""
    d = pixel_directions(64, 128)
    towards = direction(azimuth, 25.0)
    radiance = 1.0 * (d @ direction(azimuth + 70, 40.0) > 0) + 6.0 * (d @ towards > np.cos(np.radians(15)))
    out = pixel_directions(IRRADIANCE_ROWS, 2 * IRRADIANCE_ROWS)
    weights = np.broadcast_to(solid_angles(64, 128), (64, 128))
    expected = np.maximum(out @ d.reshape(-1, 3).T, 0.0) @ (radiance * weights).ravel()
    found = convolved(np.repeat(radiance[..., None], 3, axis=2))[..., 1]
    assert np.abs(found - expected).max() < 0.01 * expected.max()
    assert np.sqrt(((found - expected) ** 2).mean()) < 0.002 * expected.max()


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
    total = dfg_table()[..., :2].sum(axis=-1)
    assert total.max() <= 1.002
    assert total[2, -1] == pytest.approx(1.0, abs=0.01)            # smooth: everything comes back
    assert total[-1, -1] == pytest.approx(1 - np.log(2), abs=0.01)  # alpha = 1 seen from above, closed form

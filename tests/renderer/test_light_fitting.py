"""Madsen's probe against light that is exactly of its model, and against real need."""

from __future__ import annotations

import numpy as np
import pytest

from renderer.equirectangular import pixel_directions, solid_angles
from renderer.light.fitting import MAX_ERROR, Probe, icosphere_centroids, probe_irradiance, probe_normals
from tests.renderer.light_maps import HEIGHT, WIDTH, direction, disc, radiance_map


def no_guess() -> np.ndarray:
    return np.zeros((0, 3))


def four_lights() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A map, and the directions and irradiances of its lights over an ambient radiance of 0.3."""
    places = np.array([direction(*place) for place in ((20, 50), (-110, 30), (150, -20), (179.9, 75))])
    colors = np.array([[3.0, 2.8, 2.5], [1.0, 1.2, 1.5], [0.6, 0.5, 0.4], [1.5, 1.5, 1.5]])
    radiance = np.full((HEIGHT, WIDTH, 3), 0.3)
    d, area = pixel_directions(HEIGHT, WIDTH), solid_angles(HEIGHT, WIDTH)
    for place, color in zip(places, colors, strict=True):
        row, column = np.unravel_index(np.argmax(d @ place), (HEIGHT, WIDTH))
        radiance[row, column] += color / area[row, 0]
    nearest = np.array([d.reshape(-1, 3)[np.argmax(d.reshape(-1, 3) @ place)] for place in places])
    return radiance, nearest, colors


def test_the_spheres_have_the_papers_facets() -> None:
    assert icosphere_centroids(2).shape == (320, 3)
    assert icosphere_centroids(4).shape == (5120, 3)
    normals = probe_normals()
    assert np.linalg.norm(normals, axis=1) == pytest.approx(1)
    assert np.abs(normals.sum(axis=0)).max() < 1e-9
    assert len({tuple(np.round(normal, 6)) for normal in normals}) == 320


def test_the_probe_is_lit_as_direct_summation_says() -> None:
    radiance = np.random.default_rng(4).uniform(0, 3, (HEIGHT, WIDTH, 3))
    weights = radiance * solid_angles(HEIGHT, WIDTH)[..., None]
    expected = np.maximum(probe_normals() @ pixel_directions(HEIGHT, WIDTH).reshape(-1, 3).T, 0.0) @ weights.reshape(-1, 3)
    found = probe_irradiance(radiance)
    assert np.sqrt(((found - expected) ** 2).mean()) < 2e-3 * np.sqrt((expected**2).mean())
    assert probe_irradiance(np.full((HEIGHT, WIDTH, 3), 0.7)) == pytest.approx(0.7 * np.pi, rel=1e-3)


@pytest.mark.parametrize("guessed", [False, True])
def test_four_lights_are_found_with_and_without_a_guess(guessed: bool) -> None:
    radiance, places, colors = four_lights()
    fit = Probe().fit(radiance, (lambda: places) if guessed else no_guess, 4)
    assert fit.error < 0.005
    assert fit.ambient == pytest.approx(0.3, rel=0.03)
    cosines = fit.directions @ places.T
    assert sorted(np.argmax(cosines, axis=1)) == [0, 1, 2, 3]
    assert np.degrees(np.arccos(np.clip(cosines.max(axis=1), -1, 1))).max() < 2.5      # a facet is 2.8 degrees wide
    assert fit.irradiances[np.argsort(np.argmax(cosines, axis=1))] == pytest.approx(colors, rel=0.05)


def test_the_number_of_lights_is_the_smallest_that_is_good_enough() -> None:
    radiance = four_lights()[0]
    enough = Probe().fit(radiance, no_guess)
    assert enough.error <= MAX_ERROR
    fewer = Probe().fit(radiance, no_guess, len(enough.directions) - 1)
    assert fewer.error > MAX_ERROR
    assert len(Probe().fit(radiance, no_guess, max_error=0.2).directions) < len(enough.directions)


def test_a_flat_map_needs_no_light_and_black_is_black() -> None:
    flat = Probe().fit(np.full((HEIGHT, WIDTH, 3), 0.7), no_guess)
    assert len(flat.directions) == 0
    assert flat.ambient == pytest.approx(0.7, rel=1e-3)
    for count in (None, 3):
        black = Probe().fit(np.zeros((HEIGHT, WIDTH, 3)), no_guess, count)
        assert np.isfinite(black.directions).all()
        assert (black.ambient == 0).all()
        assert (black.irradiances == 0).all()


def test_no_colour_is_negative_even_where_it_would_fit_better() -> None:
    d = pixel_directions(HEIGHT, WIDTH)
    radiance = np.repeat(np.maximum(1.0 - 1.5 * np.maximum(d[..., 1], 0.0), 0.0)[..., None], 3, axis=2)     # dark from above
    for count in (1, 3):
        fit = Probe().fit(radiance, no_guess, count)
        assert (fit.irradiances >= 0).all()
        assert (fit.ambient >= 0).all()


def test_a_moving_light_is_followed_from_the_last_fit_in_few_steps() -> None:
    probe = Probe()
    probe.fit(disc(0, 40, 3.0).rgb, no_guess, 1)
    for azimuth in range(1, 30):
        fit = probe.fit(disc(azimuth, 40, 3.0).rgb, no_guess, 1)
        assert fit.iterations <= 4
        assert np.degrees(np.arccos(fit.directions[0] @ direction(azimuth, 40))) < 1.5


def test_with_more_lights_than_there_are_nothing_breaks() -> None:
    fit = Probe().fit(radiance_map(np.full((HEIGHT, WIDTH), 0.5)).rgb, no_guess, 12)
    assert len(fit.directions) == 12
    assert np.isfinite(fit.directions).all()
    assert fit.error < 1e-3

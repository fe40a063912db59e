"""What the camera has clipped: restored by reasons, bounded, steady, and never where nothing was clipped."""

from __future__ import annotations

import numpy as np
import pytest

from renderer.equirectangular import pixel_directions, solid_angles
from renderer.light.highlights import MAX_GLOW, MAX_LAMP, HighlightRestorer, glow_gain
from renderer.light.inverse_tone_mapping import WEIGHTS, gain, radiance_from_linear
from renderer.light.radiance_map import RadianceMap
from tests.renderer.light_maps import HEIGHT, WIDTH, direction


def shown(linear: np.ndarray) -> RadianceMap:
    """A map of linear light, (height, width), as a camera shows it."""
    clipped = np.clip(linear, 0.0, 1.0)
    return RadianceMap(radiance_from_linear(np.repeat(clipped[..., None], 3, axis=2)), (linear >= 1.0).astype(float))


def discs(*places: tuple[float, float, float], value: float = 30.0, sky: float = 0.3) -> np.ndarray:
    d, linear = pixel_directions(HEIGHT, WIDTH), np.full((HEIGHT, WIDTH), sky)
    for azimuth, elevation, radius in places:
        linear[d @ direction(azimuth, elevation) > np.cos(np.radians(radius))] = value
    return linear


def factor(radiance_map: RadianceMap, azimuth: float, elevation: float, **options: float) -> float:
    """By which the texel there is brighter than a linear camera's white."""
    restored = HighlightRestorer().restore(radiance_map, 1.0, **options)
    texel = np.unravel_index(np.argmax(pixel_directions(HEIGHT, WIDTH) @ direction(azimuth, elevation)), (HEIGHT, WIDTH))
    return float(restored.rgb[texel] @ WEIGHTS / 1.8)


def test_what_is_not_clipped_stays_as_it_is() -> None:
    given = shown(np.full((HEIGHT, WIDTH), 0.7))
    assert HighlightRestorer().restore(given, 1.0) is given


@pytest.mark.parametrize("exponent", [1.5, 2.0, 3.0])
def test_a_glow_goes_on_as_it_grew(exponent: float) -> None:
    """Of a sky whose radiance is distributed by Pareto the clipped part has that mean."""
    share = ((1 - pixel_directions(HEIGHT, WIDTH)[..., 1]) / 2).clip(1e-4)      # of the sphere that is brighter
    linear = (share / 0.05) ** (-1 / exponent)                                  # five hundredths are above white
    assert glow_gain(linear * np.where(linear <= 1, gain(linear), 11.8)) == pytest.approx(exponent / (exponent - 1), rel=0.1)


def test_glow_is_bounded_and_defined_for_any_frame() -> None:
    for linear in (np.zeros((HEIGHT, WIDTH)), np.ones((HEIGHT, WIDTH)), discs((0, 30, 20))):
        assert 1.0 <= glow_gain(shown(linear).rgb @ WEIGHTS) <= MAX_GLOW


def test_a_lamp_is_raised_a_window_less_a_reflection_and_a_glint_not() -> None:
    window = shown(discs((0, 30, 20)))
    lamps = shown(discs((0, 50, 3), (90, 50, 3), (90, 20, 25)))
    below = shown(discs((0, -50, 3), (90, 20, 25)))
    assert factor(lamps, 0, 50) > 0.5 * MAX_LAMP
    assert factor(window, 0, 30) <= MAX_GLOW + 1e-6
    assert factor(below, 0, -50) <= MAX_GLOW + 1e-6


def test_one_small_light_alone_is_what_lights_the_scene() -> None:
    given = shown(discs((0, 35, 2)))
    restored = HighlightRestorer().restore(given, 1.0)
    weights = solid_angles(HEIGHT, WIDTH)
    lit = float(((restored.rgb - given.rgb * (given.clipped == 0)[..., None]) @ WEIGHTS * weights).sum())
    mean = float((given.rgb @ WEIGHTS * weights * (given.clipped == 0)).sum()) / 4
    assert 0.5 < lit / mean < 1.6


def test_under_a_clear_sky_there_are_no_lamps_and_a_given_gain_is_taken() -> None:
    lamps = shown(discs((0, 50, 3), (90, 20, 25)))
    assert factor(lamps, 0, 50, clear=1.0) <= MAX_GLOW + 1e-6
    assert factor(lamps, 0, 50, gain=7.0) == pytest.approx(7.0 * 11.8 / 1.8)
    assert HighlightRestorer().restore(lamps, 1.0, gain=7.0).raised.max() == pytest.approx(7.0)     # type: ignore[union-attr]


def test_a_texel_that_is_clipped_in_part_is_raised_in_part() -> None:
    given = shown(discs((0, 50, 3)))
    half = RadianceMap(np.where(given.clipped[..., None] > 0, 6.0, given.rgb), given.clipped * 0.5)
    raised = HighlightRestorer().restore(half, 1.0, gain=3.0).raised
    assert raised is not None
    assert raised.max() == pytest.approx(1 + 0.5 * 11.8 / 6.0 * 2)
    assert raised.min() == 1.0


def test_the_glow_changes_slowly_and_starts_anew_after_a_cut() -> None:
    """Two skies whose clipped parts have different means, alternating: what is restored hardly moves."""
    share = ((1 - pixel_directions(HEIGHT, WIDTH)[..., 1]) / 2).clip(1e-4)
    skies = [shown((share / 0.05) ** (-1 / exponent)) for exponent in (1.5, 3.0)]
    restorer = HighlightRestorer()
    found = [restorer.restore(skies[index % 2], 1 / 30, clear=1.0).raised[0, 0] for index in range(60)]     # type: ignore[index]
    assert np.abs(np.diff(np.log(found))).max() < 0.03
    restorer.reset()
    assert restorer.restore(skies[1], 1 / 30, clear=1.0).raised[0, 0] < 0.7 * found[0]                      # type: ignore[index]

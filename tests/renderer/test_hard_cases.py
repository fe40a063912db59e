"""Frames on which light is hard to read: the cases of `server/bench/hard_cases.py`, and properties that hold for any frame."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from renderer.equirectangular import pixel_directions, solid_angles
from renderer.frame import RadianceFrame
from renderer.light.inverse_tone_mapping import WEIGHTS
from renderer.scene import Lighting
from server.bench.hard_cases import METHODS, MissedError, is_finite, light_cases, nearly, outcomes
from server.bench.pipelines import Pipelines
from tests.renderer.frames import noise_frame
from tests.renderer.light_maps import HEIGHT, WIDTH, detect, direction, disc, radiance_map

CASES = light_cases()


@pytest.mark.usefixtures("context")
@pytest.mark.parametrize("name", CASES)
def test_hard_case(pipelines: Pipelines, name: str) -> None:
    CASES[name](pipelines)


def test_a_case_that_is_not_met_is_reported_with_what_it_missed(pipelines: Pipelines) -> None:
    def missed(_pipelines: Pipelines) -> None:
        nearly(np.array([1.0, 1.2]), 1.0, 0.1, "light")

    def broken(_pipelines: Pipelines) -> None:
        raise ZeroDivisionError("no light")

    found = dict(outcomes(pipelines, {"met": lambda _: None, "missed": missed, "broken": broken}))
    assert found == {"met": None, "missed": "light: [1.  1.2], expected [1.] within 0.1", "broken": "ZeroDivisionError: no light"}
    with pytest.raises(MissedError):
        nearly(np.array([np.nan]), 1.0, 0.1, "light")


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1), lighting=st.sampled_from(list(METHODS.values())))
def test_any_noise_is_finite_by_every_method(pipelines: Pipelines, seed: int, lighting: Lighting) -> None:
    assert is_finite(pipelines.light(noise_frame((64, 32), seed), lighting))


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


def test_a_sphere_turned_by_a_right_angle_has_turned_lights(pipelines: Pipelines) -> None:
    """Pitch, resampled: what was ahead is overhead."""
    d = pixel_directions(256, 512)
    for azimuth, elevation in ((0, 0), (30, 10), (90, 5), (180, -40)):
        frames = [np.where(one @ direction(azimuth, elevation) > np.cos(np.radians(5)), 60.0, 0.4)
                  for one in (d, np.stack([d[..., 0], d[..., 2], -d[..., 1]], axis=-1))]
        plain, pitched = (pipelines.light(RadianceFrame(np.repeat(rgb[..., None], 3, axis=2).astype(np.float32))).detection.lights
                          for rgb in frames)
        assert len(plain) == len(pitched) == 1
        x, y, z = plain[0].direction
        assert np.degrees(np.arccos(min(1.0, float(pitched[0].direction @ (x, -z, y))))) < 0.5

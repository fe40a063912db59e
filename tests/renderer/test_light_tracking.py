"""Lights over time, on maps whose lights are known."""

from __future__ import annotations

import numpy as np
import pytest

from renderer.equirectangular import solid_angles
from renderer.inverse_tone_mapping import WEIGHTS
from renderer.light_detection import Detection, find_candidates
from renderer.light_tracking import LightTracker
from tests.renderer.light_maps import HEIGHT, WIDTH, direction, disc, radiance_map

FRAME_S = 1 / 30


def track(tracker: LightTracker, *lamps: tuple[float, float, float], scale: float = 1.0, noise: int | None = None) -> Detection:
    """The next frame, with lamps of (azimuth, elevation, radiance) and 3 degrees."""
    radiance = sum((disc(azimuth, elevation, 3.0, value, sky=0.0).rgb[..., 0] for azimuth, elevation, value in lamps),
                   np.full((HEIGHT, WIDTH), 0.3))
    if noise is not None:
        radiance = radiance * np.random.default_rng(noise).normal(1.0, 0.02, radiance.shape)
    return tracker.update(find_candidates(radiance_map(radiance * scale)))


def power(detection: Detection) -> float:
    """Of lights and residual together."""
    residual = float((detection.residual @ WEIGHTS * solid_angles(HEIGHT, WIDTH)).sum())
    return residual + sum(float(light.irradiance @ WEIGHTS) for light in detection.lights)


def test_a_light_keeps_its_id_while_it_moves_and_its_direction_follows() -> None:
    tracker = LightTracker()
    for azimuth in np.arange(170, 192, 0.7):     # across the seam
        light, = track(tracker, (azimuth, 30, 200.0)).lights
        assert light.id == 1
        assert np.degrees(np.arccos(light.direction @ direction(azimuth, 30))) < 0.3
    jumped = [track(tracker, (20, 30, 200.0)).lights for _ in range(12)]
    assert [light.id for light in jumped[-1]] == [2]


def test_after_a_reset_lights_are_there_at_once() -> None:
    tracker = LightTracker()
    assert len(track(tracker, (0, 30, 200.0)).lights) == 1
    tracker.reset()
    lights = track(tracker, (90, 30, 200.0), (-60, 50, 100.0)).lights
    assert [light.id for light in lights] == [2, 3]


def test_a_new_light_fades_in_and_no_energy_is_lost_meanwhile() -> None:
    tracker = LightTracker()
    track(tracker, (0, 30, 200.0))
    shares = []
    for frame in range(16):
        found = track(tracker, (0, 30, 200.0), (120, 40, 200.0))
        new = [light for light in found.lights if light.direction @ direction(120, 40) > 0.9]
        shares.append(float(new[0].irradiance[0]) if new else 0.0)
        # vector irradiance of a disc of 3 degrees is 0.14 % less than its power
        assert power(found) == pytest.approx(power(track(LightTracker(), (0, 30, 200.0), (120, 40, 200.0))), rel=2e-3), frame
    assert shares[0] == shares[1] == 0.0, "a birth needs three frames"
    assert (np.diff(shares) >= 0).all()
    assert 0.0 < shares[3] < 0.5 * shares[-1]
    assert shares[-1] == pytest.approx(np.pi * 200 * np.sin(np.radians(3)) ** 2, rel=0.01)


def test_fireflies_that_move_every_frame_are_no_lights() -> None:
    tracker = LightTracker()
    track(tracker, (0, 30, 200.0))
    places = np.random.default_rng(3).uniform(-180, 180, 60)
    strengths = []
    for azimuth in places:
        found = track(tracker, (0, 30, 200.0), (azimuth, -60 + azimuth / 9, 150.0))
        assert [light.id for light in found.lights] == [1]
        strengths.append(float(found.lights[0].irradiance[0]))
    assert np.std(strengths) / np.mean(strengths) < 0.01


def test_exposure_changes_switch_no_light() -> None:
    tracker = LightTracker()
    track(tracker, (0, 30, 200.0), (100, 40, 20.0))
    for stops in np.concatenate([np.linspace(0, -2, 20), np.linspace(-2, 1, 30)]):
        found = track(tracker, (0, 30, 200.0), (100, 40, 20.0), scale=2.0**stops)
        assert [light.id for light in found.lights] == [1, 2]
        expected = np.pi * 200 * np.sin(np.radians(3)) ** 2 * 2.0**stops
        assert found.lights[0].irradiance[0] == pytest.approx(expected, rel=0.01)


def test_a_light_near_the_gate_does_not_flicker() -> None:
    tracker = LightTracker()
    counts = [len(track(tracker, (0, 30, 200.0), (100, 40, 3.5 + 1.0 * np.sin(frame)), noise=frame).lights) for frame in range(90)]
    assert np.count_nonzero(np.diff(counts)) <= 1


def test_a_light_that_is_switched_off_is_gone_at_once() -> None:
    tracker = LightTracker()
    for _ in range(5):
        track(tracker, (0, 30, 200.0), (100, 40, 200.0))
    assert len(track(tracker, (0, 30, 200.0)).lights) == 1


def test_noise_hardly_moves_a_light() -> None:
    tracker = LightTracker()
    lights = [track(tracker, (10, 35, 200.0), noise=frame).lights[0] for frame in range(90)][30:]
    logs = np.log([light.irradiance @ WEIGHTS for light in lights])
    angles = [np.degrees(np.arccos(min(1.0, light.direction @ direction(10, 35)))) for light in lights]
    assert logs.std() < 0.005
    assert max(angles) < 0.25

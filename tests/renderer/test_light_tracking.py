"""Lights over time, on maps whose lights are known."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from renderer.equirectangular import solid_angles
from renderer.light.detection import Detection, Light, find_candidates
from renderer.light.inverse_tone_mapping import WEIGHTS
from renderer.light.sun import Sun
from renderer.light.tracking import LightNames, LightTracker
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


def dip(tracker: LightTracker, exposures: np.ndarray, *lamps: tuple[float, float, float], limit: float = 50.0) -> list[Detection]:
    """Frames of a camera whose exposure changes: lamps are cut off at `limit`, whatever they are."""
    found = []
    for exposure in exposures:
        radiance = np.full((HEIGHT, WIDTH), 0.3) * exposure
        for azimuth, elevation, value in lamps:
            radiance += np.minimum(disc(azimuth, elevation, 3.0, value, sky=0.0).rgb[..., 0] * exposure, limit)
        found.append(tracker.update(find_candidates(radiance_map(radiance))))
    return found


def test_while_the_exposure_is_another_nothing_is_born_and_nothing_dies() -> None:
    """A lamp falls below the gate and another rises above it as the exposure goes down and comes back."""
    down = np.linspace(0, -1.2, 60)
    slow = np.exp(np.concatenate([np.zeros(30), down, np.full(60, -1.2), down[::-1], np.zeros(30)]))
    found = dip(LightTracker(), slow, (0, 30, 200.0), (90, 40, 14.0), limit=20.0)
    first = {light.id for light in found[0].lights}
    assert all({light.id for light in detection.lights} == first for detection in found)
    logs = [np.log(float(light.irradiance @ WEIGHTS) / exposure) for detection, exposure in zip(found, slow, strict=True)
            for light in detection.lights if light.id == 1]
    assert np.ptp(logs) < 0.15, "its power follows the exposure, not what clips"


def test_another_exposure_that_stays_is_the_usual_one_after_a_while() -> None:
    tracker = LightTracker()
    dip(tracker, np.exp(np.linspace(0, -1.0, 60)), (0, 30, 200.0))
    later = dip(tracker, np.full(400, np.exp(-1.0)), (0, 30, 200.0), (90, 40, 200.0))
    assert len(later[0].lights) == 1
    assert len(later[-1].lights) == 2


def test_a_lamp_that_is_switched_on_is_born_however_much_brighter_the_frame_becomes() -> None:
    tracker = LightTracker()
    dip(tracker, np.ones(10), (0, 30, 200.0))
    assert len(dip(tracker, np.full(20, 1.5), (0, 30, 200.0), (90, 40, 200.0))[-1].lights) == 2


def test_a_sun_that_is_no_part_of_the_map_fades_when_it_is_lost() -> None:
    tracker, flat = LightTracker(), radiance_map(np.full((HEIGHT, WIDTH), 0.3))
    shining = find_candidates(flat, sun=Sun(direction(20, 40), np.full(3, 5.0)))
    for _ in range(5):
        found = tracker.update(shining)
    assert found.lights[0].irradiance == pytest.approx(5.0)
    powers = [float(sum(light.irradiance[0] for light in tracker.update(find_candidates(flat)).lights)) for _ in range(12)]
    assert 3.5 < powers[0] < 5.0
    assert all(later <= earlier for earlier, later in itertools.pairwise(powers))
    assert powers[-1] == 0.0
    assert tracker.update(shining).lights == (), "a new sun needs three frames"


def test_lights_without_a_memory_are_named_after_the_nearest_one_before() -> None:
    names = LightNames()

    def named(*azimuths: float) -> list[int]:
        return [light.id for light in names.named(tuple(Light(direction(azimuth, 30), np.ones(3), 0.1) for azimuth in azimuths))]

    assert named(0, 90) == [1, 2]
    assert named(92, 3) == [2, 1]
    assert named(95, 180, 5) == [2, 3, 1]
    assert named() == []
    assert named(5) == [4]


def test_a_light_fades_by_the_clock_and_its_birth_is_told_of_whatever_the_interval() -> None:
    """Births take three readings, so whoever reads less often has to know of one to read on."""
    tracker = LightTracker()
    maps = {lamps: find_candidates(radiance_map(np.full((HEIGHT, WIDTH), 0.3) + sum(
        disc(azimuth, 40, 3.0, 200.0, sky=0.0).rgb[..., 0] for azimuth in lamps))) for lamps in ((), (120,))}
    assert tracker.update(maps[()], 0.0).is_settled
    found = [tracker.update(maps[120,], moment) for moment in (0.5, 0.6, 0.61, 0.7, 0.9, 1.4)]
    assert [len(one.lights) for one in found] == [0, 0, 1, 1, 1, 1]
    assert [one.is_settled for one in found] == [False] * 4 + [True, True]
    shares = [one.lights[0].irradiance[0] / found[-1].lights[0].irradiance[0] for one in found[2:]]
    assert shares == pytest.approx([0.04, 0.4, 1.0, 1.0], abs=0.01), "of a quarter of a second"

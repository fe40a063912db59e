"""Predicted error and glance: when a light has to be read again."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from renderer.equirectangular import pixel_directions
from renderer.frame import YuvFrame
from renderer.light.detection import Detection, Light
from renderer.light.irradiance import project
from renderer.light.reading import FrameLight
from server.worker.glance import Glance
from server.worker.light_need import FIRST_READINGS, LONGEST_S, LightNeed

FRAME_S = 1 / 30
WIDTH, HEIGHT = 1024, 512
NOISE_CODES = 1.2


def light_of(sky: float, azimuth_deg: float = 20.0, lamp: float = 2.0, name: int = 1) -> FrameLight:
    """A uniform sky and one lamp at 40 degrees, with irradiance `lamp` where the sky alone gives pi times `sky`."""
    azimuth, elevation = np.radians([azimuth_deg, 40.0])
    direction = np.array([np.cos(elevation) * np.sin(azimuth), np.sin(elevation), -np.cos(elevation) * np.cos(azimuth)])
    radiance = np.full((32, 64, 3), sky, np.float32)
    detection = Detection((Light(direction, np.full(3, lamp), 0.02, name),), radiance, radiance, 1.0)
    return FrameLight(detection, project(radiance), radiance, radiance)


def intervals(lights: Iterator[FrameLight], need: LightNeed, seconds: float) -> list[float]:
    """Between readings that come when they are needed, at the next whole frame."""
    moment, end, found = 0.0, seconds, []
    while moment < end:
        need.learn(next(lights), moment)
        step = max(FRAME_S, np.ceil(need.interval_s() / FRAME_S - 0.5) * FRAME_S)
        found.append(step)
        moment += step
    return found


def test_a_light_that_only_flickers_is_read_twice_a_second() -> None:
    random = np.random.default_rng(1)
    still = (light_of(1.0 + random.normal(0, 0.004), 20 + random.normal(0, 0.03)) for _ in iter(int, 1))
    found = intervals(still, LightNeed(2048), 20.0)
    assert found[:FIRST_READINGS - 1] == [FRAME_S] * (FIRST_READINGS - 1)
    assert np.median(found[-20:]) == pytest.approx(LONGEST_S, abs=FRAME_S)


@pytest.mark.parametrize(("per_second", "expected_s"), [(0.05, 0.2), (0.1, 0.1)])
def test_a_sky_that_changes_is_read_when_it_has_changed_by_a_hundredth(per_second: float, expected_s: float) -> None:
    need, random = LightNeed(2048), np.random.default_rng(2)
    moment, found = 0.0, []
    while moment < 6.0:
        need.learn(light_of(np.exp(per_second * moment) * random.normal(1, 0.0005), lamp=0.0), moment)
        found.append(need.interval_s())
        moment += max(FRAME_S, found[-1])
    assert np.median(found[-10:]) == pytest.approx(expected_s, rel=0.35)


def test_a_sun_that_goes_round_in_half_a_minute_is_read_every_frame() -> None:
    need = LightNeed(2048)
    for index in range(30):
        need.learn(light_of(0.3, 12 * index * FRAME_S), index * FRAME_S)
    assert need.interval_s() < FRAME_S


def test_the_real_sun_needs_no_haste() -> None:
    need = LightNeed(2048)
    lights = (light_of(0.3, 20 + 0.004 * index / 30) for index in iter(iter(range(10**6)).__next__, -1))
    assert intervals(lights, need, 10.0)[-1] == pytest.approx(LONGEST_S, abs=FRAME_S)


@pytest.mark.parametrize("changed", [light_of(1.0, lamp=2.2), light_of(1.05), light_of(1.0, 22), light_of(1.0, name=2)])
def test_what_no_line_predicts_begins_all_anew(changed: FrameLight) -> None:
    need, random = LightNeed(2048), np.random.default_rng(3)
    still = (light_of(1.0 + random.normal(0, 0.001)) for _ in iter(int, 1))
    intervals(still, need, 10.0)
    assert need.interval_s() > 0.3
    need.learn(changed, 10.5)
    assert need.interval_s() == 0.0


def picture(seed: int, *, gain: float = 1.0, patches: tuple[tuple[float, float, float, int], ...] = ()) -> YuvFrame:
    """A room with a bright window, and noise. `patches` of azimuth, elevation and radius in degrees and a code of luma."""
    directions = pixel_directions(HEIGHT, WIDTH)
    codes = 60 + 40 * directions[..., 1] + 10 * np.sin(40 * directions[..., 0])
    for azimuth_deg, elevation_deg, radius_deg, code in ((90.0, 10.0, 15.0, 235), *patches):
        azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
        centre = np.array([np.cos(elevation) * np.sin(azimuth), np.sin(elevation), -np.cos(elevation) * np.cos(azimuth)])
        codes = np.where(directions @ centre > np.cos(np.radians(radius_deg)), code, codes)
    noise = np.random.default_rng(seed).normal(0, NOISE_CODES, codes.shape)
    y = np.clip(16 + (codes - 16) * gain + noise, 16, 235).round().astype(np.uint8)
    return YuvFrame(y, *(np.full((HEIGHT // 2, WIDTH // 2), 128, np.uint8),) * 2)


def glance_at_a_still_room() -> Glance:
    glance = Glance()
    assert glance.look(picture(0)).is_cut
    glance.mark()
    for seed in range(1, 10):
        seen = glance.look(picture(seed))
        assert not seen.is_cut
        assert not seen.is_changed
    return glance


@pytest.mark.parametrize("changed", [
    {"patches": ((-120.0, 60.0, 2.0, 235),)},            # a lamp is switched on
    {"patches": ((90.0, 5.0, 8.0, 30),)},                # somebody stands in front of the window
    {"gain": 1.03}, {"gain": 0.97}])                     # the camera exposes otherwise
def test_a_glance_notices_another_light_in_the_first_frame(changed: dict[str, object]) -> None:
    glance = glance_at_a_still_room()
    seen = glance.look(picture(10, **changed))  # type: ignore[arg-type]
    assert seen.is_changed
    assert not seen.is_cut
    assert glance.look(picture(11, **changed)).is_changed, "it is another light until it is marked"  # type: ignore[arg-type]
    noticed = []
    for seed in range(12, 30):
        glance.mark()
        noticed.append(glance.look(picture(seed, **changed)).is_changed)  # type: ignore[arg-type]
    assert not any(noticed[-5:]), "what flickers about white is taken for noise after a while"


def test_a_glance_does_not_mind_what_does_not_light() -> None:
    glance = glance_at_a_still_room()
    assert not glance.look(picture(10, patches=((0.0, -30.0, 4.0, 80),))).is_changed


def test_a_cut_is_no_change_of_light() -> None:
    glance = glance_at_a_still_room()
    assert glance.look(picture(10, gain=1.6)).is_cut

"""The synthetic camera keeps what it promises: where the sun is, what it looks like, which way shadows fall."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from server.demo.camera import LOOP_SECONDS, SUN_RADIUS_RAD, Camera, sun_azimuth, sun_direction
from server.demo.landscape import CAMERA_HEIGHT_M, POSTS, Post

WHITE = 234


@pytest.fixture(scope="module")
def camera() -> Camera:
    return Camera(1024)


def directions(shape: tuple[int, int]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Unit vectors (height, width, 3) and solid angles (height, 1) of the pixels, by README's definition of u and v."""
    height, width = shape
    polar = (np.arange(height) + 0.5)[:, None] / height * np.pi
    azimuth = ((np.arange(width) + 0.5) / width - 0.5) * 2 * np.pi
    vectors = np.stack([np.sin(polar) * np.sin(azimuth), np.cos(polar) + 0 * azimuth,
                        -np.sin(polar) * np.cos(azimuth)], -1)
    return vectors, np.sin(polar) * (np.pi / height) * (2 * np.pi / width)


def luma_at(camera: Camera, pts: float, x: float, z: float) -> float:
    """Mean luma of 3×3 pixels around the ground point (x, z)."""
    y, _, _ = camera.frame(pts)
    u = 0.5 + math.atan2(x, -z) / (2 * math.pi)
    v = math.acos(-CAMERA_HEIGHT_M / math.hypot(x, CAMERA_HEIGHT_M, z)) / math.pi
    row, column = int(v * y.shape[0]), int(u * y.shape[1])
    return float(y[row - 1:row + 2, column - 1:column + 2].mean())


@pytest.mark.parametrize("pts", [0.0, 4.9, 5.0, 5.1, 12.34, 20.0, 29.9, 71.0])
def test_the_clipped_disc_is_centred_on_the_sun_direction(camera: Camera, pts: float) -> None:
    y, _, _ = camera.frame(pts)
    vectors, solid_angle = directions(y.shape)
    centre = (vectors * (solid_angle * (y >= WHITE))[..., None]).sum((0, 1))
    cosine = centre @ np.array(sun_direction(pts)) / np.linalg.norm(centre)
    assert math.degrees(math.acos(min(cosine, 1.0))) < 0.1


def test_the_sun_and_only_the_sun_is_clipped(camera: Camera) -> None:
    y, cb, cr = camera.frame(11.0)
    vectors, solid_angle = directions(y.shape)
    clipped = y >= WHITE
    angle = np.degrees(np.arccos(np.clip(vectors @ np.array(sun_direction(11.0)), -1, 1)))
    assert angle[clipped].max() < 2.5
    expected = 2 * math.pi * (1 - math.cos(SUN_RADIUS_RAD))
    assert (solid_angle * clipped).sum() == pytest.approx(expected, rel=0.15)
    assert int(y.max()) == 235
    inside = angle[::2, ::2] < 1.5
    assert set(cb[inside]) == {128}
    assert set(cr[inside]) == {128}


def test_the_sun_goes_round_once_at_constant_height() -> None:
    heights = {round(sun_direction(pts)[1], 9) for pts in np.linspace(0, LOOP_SECONDS, 50)}
    assert len(heights) == 1
    assert sun_direction(3.0) == pytest.approx(sun_direction(3.0 + LOOP_SECONDS))
    assert sun_azimuth(1.0) - sun_azimuth(0.0) == pytest.approx(math.radians(360 / LOOP_SECONDS))
    forward = next(pts for pts in np.arange(0, LOOP_SECONDS, 0.5) if abs(sun_direction(pts)[0]) < 1e-6
                   and sun_direction(pts)[2] < 0)
    right = sun_direction(forward + LOOP_SECONDS / 4)
    assert right[0] > 0.7
    assert right[2] == pytest.approx(0, abs=1e-9)


def test_the_loop_closes(camera: Camera) -> None:
    for first, again in zip(camera.frame(0.0), camera.frame(float(LOOP_SECONDS)), strict=True):
        assert np.array_equal(first, again)


def shadow_point(post: Post, pts: float) -> tuple[float, float]:
    """A ground point (x, z) well inside the post's shadow."""
    sun = sun_direction(pts)
    reach = post.radius + 0.6 * post.height / sun[1]
    return post.x - sun[0] * reach, post.z - sun[2] * reach


def visible(post: Post, pts: float) -> bool:
    """The post does not stand in front of the middle of its own shadow."""
    x, z = shadow_point(post, pts)
    aside = abs(post.x * z - post.z * x) / math.hypot(x, z)
    return math.hypot(x, z) < math.hypot(post.x, post.z) or aside > 2 * post.radius


@pytest.mark.parametrize(("post", "pts"), [(post, pts) for post in POSTS for pts in (1.0, 9.0, 17.5, 26.0)
                                           if visible(post, pts)])
def test_shadows_fall_away_from_the_sun(camera: Camera, post: Post, pts: float) -> None:
    x, z = shadow_point(post, pts)
    assert luma_at(camera, pts, x, z) < luma_at(camera, pts + LOOP_SECONDS / 2, x, z) - 25


def test_what_the_sun_does_not_move_stays_but_for_noise(camera: Camera) -> None:
    one, _, _ = camera.frame(3.0)
    other, _, _ = camera.frame(18.0)
    near_ground = slice(int(one.shape[0] * 0.85), None)
    difference = one[near_ground].astype(int) - other[near_ground]
    assert 0.3 < difference.std() < 2.0
    assert abs(difference.mean()) < 0.1


@pytest.mark.parametrize("width", [0, 254, 258, 1023, 9000])
def test_a_width_that_cannot_be_made_is_named(width: int) -> None:
    with pytest.raises(ValueError, match=f"width is {width}, expected"):
        Camera(width)

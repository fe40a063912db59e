"""What metals show of what stands around them: other objects, and the ground's shadows."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from renderer.equirectangular import pixel_directions, uv_from_direction
from renderer.frame import RadianceFrame
from renderer.gl import Context
from renderer.models.shapes import hit
from renderer.pipeline import Pipeline
from renderer.scene import Scene
from tests.renderer.frames import direction, scene, sky_with_sun

SIZE = (512, 256)
CENTRE = np.array([0.0, -1.1, -2.5])
MIRROR = {"base_color": [1, 1, 1], "metallic": 1, "roughness": 0}
BALL = {"mesh": "sphere", "position": list(CENTRE), "material": MIRROR, "casts_shadow": True}
RED_BOX = {"mesh": "box", "position": [1.1, -1.1, -2.5], "material": {"base_color": [0.8, 0.0, 0.0], "roughness": 1.0},
           "casts_shadow": False}


def flat(value: float = 0.5) -> RadianceFrame:
    return RadianceFrame(np.full((SIZE[1], SIZE[0], 3), value, dtype=np.float32))


def picture(context: Context, frame: RadianceFrame, wanted: Scene) -> np.ndarray:
    pipeline = Pipeline(context, RadianceFrame, frame.size)
    rendered = pipeline.render(frame, wanted)
    pipeline.release()
    assert rendered.errors == {}
    assert isinstance(rendered.frame, RadianceFrame)
    return rendered.frame.rgb


def ball_pixels(within: float = 0.44) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A mask of the ball's pixels away from its outline; for each the place on it and the mirrored ray."""
    directions = pixel_directions(SIZE[1], SIZE[0])
    mask = (np.linalg.norm(np.cross(directions, CENTRE), axis=-1) < within) & (directions @ CENTRE > 0)
    rays = directions[mask]
    distance, normals = hit("ellipsoid", np.broadcast_to(-CENTRE, rays.shape), rays)
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    return mask, rays * distance[:, None], rays - 2 * (rays * normals).sum(axis=1, keepdims=True) * normals


def meets_box(at: np.ndarray, rays: np.ndarray, size: float = 0.85) -> np.ndarray:
    """Which rays meet the red box away from its edges, or one of another size."""
    return np.isfinite(hit("box", (at - np.array(RED_BOX["position"])) / size, rays)[0])


@pytest.mark.parametrize(("roughness", "least"), [(0.0, 2.0), (0.2, 1.5)])
def test_a_mirror_shows_a_box_where_its_rays_meet_it(context: Context, roughness: float, least: float) -> None:
    ball = {**BALL, "material": {**MIRROR, "roughness": roughness}}
    found = picture(context, flat(), scene(ball, RED_BOX, ground={"catcher": False}))
    mask, at, rays = ball_pixels()
    meets = meets_box(at, rays)
    assert meets.sum() > 20
    red_share = found[mask][:, 0] / found[mask][:, 1]
    assert (red_share[meets] > least).mean() > 0.9
    passes = ~meets_box(at, rays, 1.15)
    assert (np.abs(red_share[passes] - 1.0) < 0.02).mean() > 0.95 - roughness
    far_side = rays @ [1, 0, 0] < -0.2
    assert far_side.sum() > 100
    assert red_share[far_side] == pytest.approx(1.0, abs=0.01)
    assert found[mask][far_side][:, 1] == pytest.approx(0.5, rel=0.05)


def test_the_box_has_the_brightness_in_the_mirror_that_it_has_itself(context: Context) -> None:
    """Under a flat sky a matte box shines with its colour times the sky, and with what its coat reflects."""
    found = picture(context, flat(), scene(BALL, RED_BOX, ground={"catcher": False}))
    mask, at, rays = ball_pixels()
    meets = meets_box(at, rays)
    itself = uv_from_direction(np.array([1.1, -1.1, -2.0])) * SIZE
    expected = found[int(itself[1]), int(itself[0])]
    assert np.median(found[mask][meets][:, 0]) == pytest.approx(expected[0], rel=0.15)
    assert np.median(found[mask][meets][:, 1]) < 0.15 * expected[0]


def test_a_matte_object_shows_no_box(context: Context) -> None:
    ball = {**BALL, "material": {"base_color": [0.5, 0.5, 0.5], "metallic": 0, "roughness": 0.1}}
    alone = picture(context, flat(), scene(ball, ground={"catcher": False}))
    beside = picture(context, flat(), scene(ball, {**RED_BOX, "position": [1.6, -1.1, -2.5]}, ground={"catcher": False}))
    mask, _, rays = ball_pixels()
    left = rays @ [1, 0, 0] < -0.3
    assert beside[mask][left] == pytest.approx(alone[mask][left], rel=0.15)


def shadow_share(points: np.ndarray, towards_sun: np.ndarray) -> np.ndarray:
    """How far from the ball's centre, in radii, the sun's middle passes it seen from each point of the ground."""
    return np.asarray(np.linalg.norm(np.cross(CENTRE - points, towards_sun), axis=1) / 0.5)


@pytest.mark.parametrize("azimuth", [0.0, -35.0])
def test_a_mirror_shows_its_own_shadow_on_the_ground(context: Context, azimuth: float) -> None:
    frame = sky_with_sun(azimuth, 50, size=SIZE, sun=4000.0, sky=0.2)
    with_shadow = picture(context, frame, scene(BALL))
    without = picture(context, frame, scene({**BALL, "casts_shadow": False}))
    mask, at, rays = ball_pixels()
    down = rays[:, 1] < -0.05
    ground = at + rays * ((-1.6 - at[:, 1]) / np.where(down, rays[:, 1], -1.0))[:, None]
    passes, near = shadow_share(ground, direction(azimuth, 50)), np.linalg.norm((ground - CENTRE)[:, [0, 2]], axis=1) < 2.0
    change = with_shadow[mask][:, 1] / without[mask][:, 1]
    dark, bright = down & near & (passes < 0.7), down & near & (passes > 1.8)
    assert dark.sum() > 20
    assert bright.sum() > 20
    sun = np.pi * 4000 * np.sin(np.radians(2.0)) ** 2 * np.sin(np.radians(50))
    remains = np.pi * 0.2 / (np.pi * 0.2 + sun)     # of the ground's light, at most
    assert np.percentile(change[dark], 80) < remains + 0.1
    assert np.median(change[bright]) > 0.75
    assert change[rays[:, 1] > 0.05] == pytest.approx(1.0, abs=0.01), "the sky is what it is"


def test_the_ground_far_from_all_shadows_is_the_frames_own(context: Context) -> None:
    """A mirror shows the frame where its ray meets the ground: without shadows that is all there is to it."""
    frame = sky_with_sun(120, 50, size=SIZE)
    frame.rgb[160:] *= np.linspace(1.0, 0.3, 96)[:, None, None].astype(np.float32)
    found = picture(context, frame, scene({**BALL, "casts_shadow": False}))
    mask, at, rays = ball_pixels(0.4)
    down = rays[:, 1] < -0.15
    ground = at + rays * ((-1.6 - at[:, 1]) / np.where(down, rays[:, 1], -1.0))[:, None]
    uv = uv_from_direction(ground[down] / np.linalg.norm(ground[down], axis=1, keepdims=True))
    expected = frame.rgb[(uv[:, 1] * SIZE[1]).astype(int), (uv[:, 0] * SIZE[0]).astype(int) % SIZE[0], 1]
    assert np.ptp(expected) > 0.1
    assert np.abs(found[mask][down][:, 1] - expected).mean() < 0.03


def test_twenty_objects_reflect_their_nearest_neighbours(context: Context) -> None:
    """More than a program has room for."""
    row: list[dict[str, Any]] = [{**RED_BOX, "position": [-9.5 + i, -1.1, -6.0], "scale": [0.5, 0.5, 0.5]} for i in range(19)]
    found = picture(context, flat(), scene(BALL, *row, RED_BOX, ground={"catcher": False}))
    mask, at, rays = ball_pixels()
    meets = meets_box(at, rays)
    assert (found[mask][meets][:, 0] / found[mask][meets][:, 1] > 2.0).mean() > 0.9


def test_after_a_cut_the_grounds_shadow_is_the_new_lights(context: Context) -> None:
    """The reflected picture of the ground may be some frames late, but not across a cut."""
    wanted, size = scene(BALL), SIZE
    cut_to = sky_with_sun(-60, 50, size=size, sun=4000.0)
    pipeline = Pipeline(context, RadianceFrame, size)
    pipeline.render(sky_with_sun(60, 50, size=size, sun=4000.0), wanted)
    pipeline.reset()
    after = pipeline.render(cut_to, wanted).frame
    pipeline.release()
    assert isinstance(after, RadianceFrame)
    assert after.rgb == pytest.approx(picture(context, cut_to, wanted), abs=1e-3)

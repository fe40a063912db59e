"""What metals show of lights and of what is over and under the horizon."""

from __future__ import annotations

import numpy as np
import pytest

from renderer.equirectangular import pixel_directions, uv_from_direction
from renderer.frame import RadianceFrame
from renderer.gl import Context
from renderer.light.detection import Detection, Light
from renderer.light.discs import disc_directions, share_below_horizon
from renderer.light.reading import FrameLight
from renderer.light.specular import dfg_table, prefilter, prefilter_split
from renderer.pipeline import Pipeline
from renderer.scene import Scene
from tests.renderer.frames import direction, scene

SIZE = (512, 256)
CENTRE, RADIUS = np.array([0.0, -0.5, -2.0]), 0.5


def ball(roughness: float) -> dict[str, object]:
    return {"mesh": "sphere", "position": list(CENTRE), "casts_shadow": False,
            "material": {"base_color": [1, 1, 1], "metallic": 1, "roughness": roughness}}


def picture(context: Context, frame: RadianceFrame, wanted: Scene, light: FrameLight | None = None) -> np.ndarray:
    pipeline = Pipeline(context, RadianceFrame, SIZE)
    rendered = pipeline.render(frame, wanted, light=light)
    pipeline.release()
    assert isinstance(rendered.frame, RadianceFrame)
    return rendered.frame.rgb[..., 0].astype(np.float64)


def ball_normals(within: float = 0.45) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The mask of the ball's pixels away from its outline; for each the direction that it is seen in, and the normal."""
    directions = pixel_directions(SIZE[1], SIZE[0])
    along = directions @ CENTRE
    aside2 = CENTRE @ CENTRE - along**2
    mask = (aside2 < within**2) & (along > 0)
    distance = along - np.sqrt(np.maximum(RADIUS**2 - aside2, 0.0))
    return mask, directions[mask], (directions[mask] * distance[mask][:, None] - CENTRE) / RADIUS


def reflected(normals: np.ndarray, views: np.ndarray, lights: np.ndarray, alpha: float) -> np.ndarray:
    """(n, k) GGX with Smith's height-correlated shadowing times the cosine, F = 1."""
    half = views[:, None] + lights[None]
    half /= np.linalg.norm(half, axis=2, keepdims=True)
    n_l = np.maximum(normals @ lights.T, 0.0)
    n_v, n_h, a2 = (normals * views).sum(axis=1)[:, None], (half * normals[:, None]).sum(axis=2), alpha**2
    shadowing = 0.5 / (n_l * np.sqrt(n_v**2 * (1 - a2) + a2) + n_v * np.sqrt(n_l**2 * (1 - a2) + a2))
    return np.asarray(a2 / (np.pi * (n_h**2 * (a2 - 1) + 1) ** 2) * shadowing * n_l)


@pytest.mark.parametrize("roughness", [0.25, 0.4, 0.7])
@pytest.mark.parametrize("radius_deg", [0.5, 3.0, 7.0])
def test_a_metal_ball_reflects_a_light_as_a_disc(context: Context, roughness: float, radius_deg: float) -> None:
    """The highlight and what is far beside it, against the sum over the disc; a wider lobe in place of the disc errs by half."""
    lamp = Light(direction(150, 25), np.full(3, 2.0), np.radians(radius_deg), id=1)
    black = np.zeros((32, 64, 3), np.float32)
    light = FrameLight(Detection((lamp,), black, black, 0.0), np.zeros((25, 3)), black, black)
    frame = RadianceFrame(np.zeros((*SIZE[::-1], 3), np.float32))
    found = picture(context, frame, scene(ball(roughness), ground={"catcher": False}), light)
    mask, seen, normals = ball_normals()
    discs = disc_directions(lamp.direction, lamp.angular_radius, 400)
    n_v = (-seen * normals).sum(axis=1)
    table = dfg_table()
    once = table[round(roughness * (len(table) - 1)), (n_v * table.shape[1]).astype(int)].sum(axis=1)   # comes back in one bounce
    expected = 2.0 * reflected(normals, -seen, discs, roughness**2).mean(axis=1) / once
    facing = (normals @ lamp.direction > 0.3) & (n_v > 0.3)
    ratio = found[mask][facing] / expected[facing]
    assert np.median(ratio) == pytest.approx(1.0, abs=0.04)
    assert np.mean(np.abs(ratio - 1) < 0.12) > 0.85


@pytest.mark.parametrize("roughness", [0.25, 0.5])
def test_the_halves_of_a_prefiltered_map_are_the_whole(roughness: float) -> None:
    radiance = np.random.default_rng(3).random((64, 128, 3)).astype(np.float32)
    split = prefilter_split(radiance, roughness)
    assert split.whole == pytest.approx(prefilter(radiance, roughness), rel=1e-3, abs=1e-4)
    share = split.above[:, 0, 3]
    middle = len(share) // 2
    assert share[:middle][::-1] == pytest.approx(1 - share[middle:], abs=1e-3)     # the horizon halves the lobe along it
    assert (np.diff(share) > -1e-6).all()


@pytest.mark.parametrize("roughness", [0.25, 0.5])
def test_under_a_uniform_sky_it_makes_no_difference_how_near_the_black_ground_is(context: Context, roughness: float) -> None:
    """What a rough ball has of the sky does not depend on where on the ground the rest of its lobe ends."""
    frame = np.zeros((*SIZE[::-1], 3), np.float32)
    frame[:SIZE[1] // 2] = 1.0
    near, far = (picture(context, RadianceFrame(frame), scene(ball(roughness), camera_height=1.01, ground={"catcher": is_near}))
                 for is_near in (True, False))
    mask, seen, normals = ball_normals()
    # away from where the ball's own horizon cuts the lobe
    level = (np.abs(normals[:, 1]) < 0.5) & ((-seen * normals).sum(axis=1) > 0.5)
    assert level.sum() > 50
    difference = near[mask][level] - far[mask][level]
    assert np.abs(difference).max() < 0.1
    assert np.sqrt((difference**2).mean()) < 0.03


@pytest.mark.parametrize(("elevation", "share"), [(10.0, 0.0), (0.0, 0.5), (-10.0, 1.0), (2.5, 0.19550)])
def test_the_share_of_a_disc_under_the_horizon_is_a_circles_segment(elevation: float, share: float) -> None:
    found = share_below_horizon(Light(direction(30, elevation), np.ones(3), np.radians(5.0)))
    assert found == pytest.approx(share, abs=2e-3)


def test_a_lamp_on_the_far_ground_lights_by_the_height_over_it(context: Context) -> None:
    """Halfway down from the camera to the ground it fills half of the view that it fills for the camera."""
    lamp = Light(direction(150, -4), np.full(3, 2.0), np.radians(1.0), id=1)
    black = np.zeros((32, 64, 3), np.float32)
    light = FrameLight(Detection((lamp,), black, black, 0.0), np.zeros((25, 3)), black, black)
    matte = {**ball(1.0), "material": {"base_color": [0.8, 0.8, 0.8], "roughness": 1.0}}
    frame = RadianceFrame(np.zeros((*SIZE[::-1], 3), np.float32))
    free, ground = (picture(context, frame, scene(matte, camera_height=1.25, ground={"catcher": is_there}), light)
                    for is_there in (False, True))
    mask, _, normals = ball_normals(0.4)
    heights = (CENTRE[1] + RADIUS * normals[:, 1] + 1.25) / 1.25
    lit = free[mask] > 0.2
    assert lit.sum() > 50
    assert ground[mask][lit] / free[mask][lit] == pytest.approx(heights[lit], abs=0.03)


def test_what_is_near_on_the_ground_is_not_blurred_as_if_it_were_far(context: Context) -> None:
    """A small rough ball on the border of a bright and a black half of the ground shows the border, which a lobe as seen from the
    camera would spread over both sides."""
    columns = pixel_directions(SIZE[1], SIZE[0])
    frame = np.where((columns[..., 1] < 0) & (columns[..., 0] < 0), 1.0, 0.0)[..., None].repeat(3, axis=2).astype(np.float32)
    small = {**ball(0.55), "position": [0.0, -1.5, -2.0], "scale": [0.2, 0.2, 0.2]}
    found = picture(context, RadianceFrame(frame), scene(small))
    centre = np.array([0.0, -1.5, -2.0])
    left, right = (found[int(v), int(u)] for u, v in (
        uv_from_direction(centre + np.array([side, -0.05, 0.07])) * SIZE for side in (-0.05, 0.05)))
    assert left > 0.97
    assert right < 0.01

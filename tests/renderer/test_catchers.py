"""Shadows on real surfaces, and what they hide: against the ground's own, and against geometry."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from renderer.equirectangular import pixel_directions
from renderer.frame import RadianceFrame
from renderer.gl import Context
from renderer.light.discs import disc_directions
from renderer.pipeline import Pipeline
from renderer.scene import Scene
from tests.renderer.frames import direction, noise_frame, sky_with_sun

SIZE = (1024, 512)
FLOOR = -1.6
DIRECTIONS = pixel_directions(SIZE[1], SIZE[0])
BALL = {"id": "ball", "mesh": "sphere", "position": [0.2, FLOOR + 0.5, -2.2], "scale": [0.8, 0.8, 0.8],
        "material": {"base_color": [0.8, 0.2, 0.1], "roughness": 1.0}}

BLACK_BALL = {**BALL, "material": {"base_color": [0, 0, 0], "roughness": 1.0}}


def surface(role: str, position: list[float], scale: list[float], name: str = "surface") -> dict[str, Any]:
    return {"id": name, "mesh": "box", "position": position, "scale": scale, "role": role}


def rendered(context: Context, frame: RadianceFrame, **scene: Any) -> NDArray[np.float64]:
    """(height, width) ratio of the green channel to the frame's."""
    pipeline = Pipeline(context, RadianceFrame, SIZE)
    found = pipeline.render(frame, Scene.model_validate(scene))
    pipeline.release()
    assert found.errors == {}
    assert isinstance(found.frame, RadianceFrame)
    return np.asarray(found.frame.rgb[..., 1] / frame.rgb[..., 1], dtype=np.float64)


def plane_hits(axis: int, at: float) -> NDArray[np.float64]:
    """(height, width, 3) where each pixel's ray meets an upright or level plane; NaN where it does not."""
    distance = at / np.where(DIRECTIONS[..., axis] * at > 1e-6, DIRECTIONS[..., axis], np.nan)
    return np.asarray(DIRECTIONS * distance[..., None])


def away_from_ball(centre: list[float], radius: float) -> NDArray[np.bool_]:
    """Pixels that the ball does not cover."""
    towards = np.array(centre)
    beside = np.linalg.norm(np.cross(DIRECTIONS, towards), axis=-1)
    return np.asarray((beside > 1.05 * radius) | (DIRECTIONS @ towards < 0))


def lit_past_ball(towards: NDArray[np.float64], sun: float, radius_deg: float, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n,) exact share of the light that (n, 3) points of the level floor still have under a black ball: of a disc of radiance
    `sun` the directions that pass the ball, of a uniform sky of 0.5 the ball's form factor."""
    to_ball = BLACK_BALL["position"] - points
    distance = np.linalg.norm(to_ball, axis=1)
    form_factor = 0.4**2 / distance**2 * to_ball[:, 1] / distance
    rays = disc_directions(towards, np.radians(radius_deg), 400)
    visible = np.array([(np.linalg.norm(np.cross(rays, one), axis=1) > 0.4).mean() for one in to_ball])
    of_sun = (sun - 0.5) * np.pi * np.sin(np.radians(radius_deg)) ** 2 * towards[1]
    return np.asarray((of_sun * visible + 0.5 * np.pi * (1 - form_factor)) / (of_sun + 0.5 * np.pi))


@pytest.mark.parametrize("composite", ["ratio", "additive"])
@pytest.mark.parametrize("sun", [400.0, 0.5])
def test_a_floor_has_as_much_light_left_as_geometry_says(context: Context, sun: float, composite: str) -> None:
    frame = sky_with_sun(40, 50, size=SIZE, sun=sun, radius_deg=4)
    scenes = {"ground": {}, "catcher": {"local_scene": [surface("catcher", [0, FLOOR - 0.5, -2.0], [8, 1, 8])],
                                        "ground": {"catcher": False}}}
    hits = plane_hits(1, FLOOR)
    seen = away_from_ball(BLACK_BALL["position"], 0.4) & (np.abs(hits - [0.2, FLOOR, -2.2]).max(axis=-1) < 1.4)
    exact = lit_past_ball(direction(40, 50), sun, 4, hits[seen])
    if composite == "additive":     # the frame itself stands in for the albedo there
        received = np.pi * 0.5 + (sun - 0.5) * np.pi * np.sin(np.radians(4)) ** 2 * np.sin(np.radians(50))
        exact = np.maximum(1 - (1 - exact) * received / np.pi, 0.0)
    for name, values in scenes.items():
        found = rendered(context, frame, objects=[BLACK_BALL], lighting={"composite": composite}, **values)[seen]
        error = np.sqrt(np.mean((found - exact)[exact < 0.97] ** 2))
        assert error < 0.035, name


def test_a_coloured_object_gives_light_back_to_a_catcher(context: Context) -> None:
    frame = sky_with_sun(180, 40, size=SIZE, sun=400.0, radius_deg=4)       # on the side that is seen
    pipeline = Pipeline(context, RadianceFrame, SIZE)
    found = pipeline.render(frame, Scene.model_validate({
        "objects": [BALL], "local_scene": [surface("catcher", [0, FLOOR - 0.5, -2.0], [8, 1, 8])], "ground": {"catcher": False}}))
    pipeline.release()
    assert isinstance(found.frame, RadianceFrame)
    in_front = np.linalg.norm(plane_hits(1, FLOOR) - [0.2, FLOOR, -1.75], axis=-1) < 0.15
    red, green, blue = (found.frame.rgb / frame.rgb)[in_front].mean(axis=0)
    assert red > green + 0.01 > blue + 0.01


@pytest.mark.parametrize("wall", [-3.0, 3.0])       # ahead, and on the seam
def test_a_shadow_on_a_wall_lies_where_the_light_throws_it(context: Context, wall: float) -> None:
    ball = {**BALL, "position": [0.3, 0.1, wall - np.sign(wall) * 1.0], "scale": [0.5, 0.5, 0.5]}
    # from behind the camera's shoulder, so that the shadow is beside the ball
    towards = direction(140 if wall < 0 else 40, 25)
    frame = sky_with_sun(140 if wall < 0 else 40, 25, size=SIZE, sun=2000.0, radius_deg=1.5)
    local = [surface("catcher", [0, 0, wall + np.sign(wall) * 0.05], [6, 4, 0.1])]
    ratio = rendered(context, frame, objects=[ball], local_scene=local, ground={"catcher": False})
    offset = plane_hits(2, wall) - ball["position"]
    hidden = np.linalg.norm(offset - (offset @ towards)[..., None] * towards, axis=-1) < 0.25
    seen = away_from_ball(ball["position"], 0.25) & (DIRECTIONS[..., 2] * wall > 0.5)
    expected, found = np.where(seen & hidden, 1.0, 0.0), np.where(seen, np.clip(1 - ratio - 0.3, 0, 1), 0.0)
    assert expected.sum() > 100
    columns, rows = np.meshgrid((np.arange(SIZE[0]) + SIZE[0] // 2 * (wall > 0)) % SIZE[0], np.arange(SIZE[1]))
    for axis in (rows, columns):
        assert (found * axis).sum() / found.sum() == pytest.approx((expected * axis).sum() / expected.sum(), abs=1.0)
    assert ratio[(expected > 0) & (found > 0)].mean() < 0.45     # what is left is the sky's


def test_a_room_around_the_camera_catches_shadows_and_hides_no_light(context: Context) -> None:
    frame = sky_with_sun(140, 25, size=SIZE, sun=2000.0, radius_deg=1.5)
    ball = {**BALL, "position": [0.3, 0.1, -2.0], "scale": [0.5, 0.5, 0.5]}
    open_air = rendered(context, frame, objects=[ball], ground={"catcher": False})
    room = rendered(context, frame, objects=[ball], ground={"catcher": False},
                    local_scene=[surface("catcher", [0, 0, 0], [6, 4, 6]), surface("occluder", [0, 0, 0], [6, 4, 6], "walls")])
    on_ball = ~away_from_ball(ball["position"], 0.2)
    assert np.allclose(room[on_ball], open_air[on_ball], rtol=0.02)
    assert (room[~on_ball] < 0.4).sum() > 100


def test_an_occluder_hides_the_grounds_shadow(context: Context) -> None:
    frame = sky_with_sun(-90, 40, size=SIZE, sun=2000.0, radius_deg=1.5)
    pillar = surface("occluder", [0.7, FLOOR + 0.4, -1.5], [0.3, 0.8, 0.3])
    without = rendered(context, frame, objects=[BALL])
    ratio = rendered(context, frame, objects=[BALL], local_scene=[pillar])
    front = plane_hits(2, -1.35)
    on_pillar = (np.abs(front[..., 0] - 0.7) < 0.14) & (front[..., 1] > FLOOR + 0.01) & (front[..., 1] < FLOOR + 0.78)
    assert without[on_pillar].min() < 0.4
    assert (ratio[on_pillar] == 1.0).all()
    beside = (front[..., 0] < 0.43) & (without < 0.5)     # of its left side, too; behind it lies its own shadow
    assert beside.sum() > 30
    assert np.allclose(ratio[beside], without[beside], atol=0.05)


def test_what_a_table_shades_already_gets_no_darker(context: Context) -> None:
    frame = sky_with_sun(180, 60, size=SIZE, sun=2000.0, radius_deg=1.5)
    cup = {**BALL, "position": [0.0, -0.85, -2.0], "scale": [0.3, 0.3, 0.3]}
    table = surface("catcher", [0, -1.05, -2.0], [2.0, 0.1, 2.0])
    on_floor = plane_hits(1, FLOOR)
    # under the table, where the cup alone would throw its shadow
    place = np.linalg.norm(on_floor - [0.0, FLOOR, -2.0 - 0.75 / np.tan(np.radians(60))], axis=-1) < 0.1
    alone = rendered(context, frame, objects=[cup])
    ground_only = rendered(context, frame, objects=[cup], local_scene=[table])
    assert place.sum() > 20
    assert alone[place].max() < 0.5
    assert ground_only[place].min() > 0.9


def test_catchers_are_unseen(context: Context) -> None:
    frame = noise_frame(SIZE)
    local = [surface("catcher", [0, -1.0, -2], [1, 0.1, 1]), surface("occluder", [1, -1.0, -2], [0.5, 1, 1], "other")]
    pipeline = Pipeline(context, type(frame), SIZE)
    for objects in ([], [{**BALL, "casts_shadow": False}]):
        result = pipeline.render(frame, Scene.model_validate({"objects": objects, "local_scene": local}))
        seen = np.kron(away_from_ball([0.2, FLOOR + 0.5, -2.2], 0.42)[::2, ::2], np.ones((2, 2), dtype=bool)).astype(bool)
        assert np.array_equal(result.frame.y[seen], frame.y[seen])     # type: ignore[union-attr]
    pipeline.release()


def test_a_catcher_is_drawn_anew_when_the_light_or_an_object_is_another(context: Context) -> None:
    pipeline = Pipeline(context, RadianceFrame, SIZE)
    local = [surface("catcher", [0, FLOOR - 0.5, -2.0], [8, 1, 8])]
    scenes = [Scene.model_validate({"objects": [{**BALL, "position": [x, FLOOR + 0.5, -2.2]}], "local_scene": local,
                                    "ground": {"catcher": False}}) for x in (0.2, 0.5)]
    spot = np.linalg.norm(plane_hits(1, FLOOR) - [0.0, FLOOR, -1.85], axis=-1) < 0.1
    seen = []
    for azimuth, scene in ((40, scenes[0]), (40, scenes[0]), (180, scenes[0]), (180, scenes[1])):
        frame = sky_with_sun(azimuth, 50, size=SIZE)
        light, _ = pipeline.analyse(frame)
        for _ in range(8):      # live: the light of an earlier frame
            found = pipeline.render(frame, scene, light=light)
            pipeline.prepare(light)
        fresh = rendered(context, frame, objects=[item.model_dump() for item in scene.objects], local_scene=local,
                         ground={"catcher": False})
        assert isinstance(found.frame, RadianceFrame)
        ratio = found.frame.rgb[..., 1] / frame.rgb[..., 1]
        assert np.abs(ratio - fresh)[spot].mean() < 0.06        # what has just moved is drawn coarsely
        seen.append(float(ratio[spot].mean()))
    pipeline.release()
    assert seen[0] == pytest.approx(seen[1], abs=0.01)
    assert np.ptp(seen) > 0.1


def test_catchers_that_are_not_seen_or_many_do_no_harm(context: Context) -> None:
    frame = sky_with_sun(40, 50, size=SIZE)
    alone = rendered(context, frame, objects=[BALL])
    below = surface("catcher", [0, FLOOR - 3.0, -2.0], [1, 1, 1], "below")
    far = [surface("catcher", [0.01 * i, 3.0, 50.0], [0.001, 0.001, 0.001], f"speck-{i}") for i in range(200)]
    assert np.allclose(rendered(context, frame, objects=[BALL], local_scene=[below, *far]), alone, atol=0.02)
    assert np.isfinite(rendered(context, frame, objects=[BALL], local_scene=[below], ground={"catcher": False})).all()

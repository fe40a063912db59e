"""Scenes that stand in no textbook: objects in each other, flat ones, lights at the horizon and below the ground, none at all."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from renderer.equirectangular import uv_from_direction
from renderer.frame import RadianceFrame
from renderer.gl import Context
from renderer.light.detection import Detection, Light
from renderer.light.reading import FrameLight
from renderer.objects import surfaces
from renderer.pipeline import Pipeline
from renderer.scene import Scene
from tests.renderer.frames import direction, scene, sky_with_sun

SIZE = (256, 128)
METAL = {"base_color": [0.9, 0.9, 0.9], "metallic": 1, "roughness": 0.1}
BALL: dict[str, Any] = {"mesh": "sphere", "position": [0, -1.1, -3]}
BOX: dict[str, Any] = {"mesh": "box", "position": [1.0, -1.1, -3], "material": METAL}
SCENES: dict[str, list[dict[str, Any]]] = {
    "touching": [BALL, BOX], "one inside another": [BALL, {**BOX, "position": [0, -1.1, -3], "scale": [0.2, 0.2, 0.2]}],
    "the same place": [BALL, {**BALL, "material": METAL}, BOX, {**BOX, "material": None}],
    "half in the ground": [{**BALL, "position": [0, -1.6, -3]}, {**BOX, "position": [1, -1.8, -3]}],
    "flat boxes": [BALL, *({**BOX, "position": [0.7, -1.1, -3 + shift], "scale": flat} for shift, flat in
                           ((0.0, [1e-6, 1, 1]), (0.1, [1, 1e-6, 1]), (0.2, [1, 1, 1e-6])))],
    "mirrored and long": [{**BALL, "scale": [-1, 1, 1], "material": METAL}, {**BOX, "scale": [0.01, 0.01, 10.0]}],
    "small and large": [{**BALL, "scale": [0.001, 0.001, 0.001]}, {**BOX, "position": [0, 0, -60], "scale": [50, 50, 50]}],
}


def finite_picture(context: Context, frame: RadianceFrame, wanted: Scene, light: FrameLight | None = None) -> np.ndarray:
    pipeline = Pipeline(context, RadianceFrame, frame.size)
    rendered = pipeline.render(frame, wanted, light=light)
    again = pipeline.render(frame, wanted, light=light)     # by what was kept
    pipeline.release()
    assert rendered.errors == {}
    for result in (rendered.frame, again.frame):
        assert isinstance(result, RadianceFrame)
        assert np.isfinite(result.rgb).all()
        assert (result.rgb >= 0).all()
    assert isinstance(rendered.frame, RadianceFrame)
    return rendered.frame.rgb


def lit_by(*lights: Light) -> FrameLight:
    flat = np.full((32, 64, 3), 0.3)
    return FrameLight(Detection(lights, flat, flat, 0.0), np.zeros((25, 3)), flat.astype(np.float32),
                      np.full((32, 64, 3), 0.3 * np.pi, np.float32))


@pytest.mark.parametrize("name", SCENES)
def test_objects_anywhere_give_a_picture(context: Context, name: str) -> None:
    frame = sky_with_sun(60, 35, size=SIZE)
    picture = finite_picture(context, frame, scene(*SCENES[name]))
    assert (picture != frame.rgb).any()
    plausible = picture[frame.rgb[..., 0] < 100]
    assert plausible.max() < 60, "no brighter than a metal makes the sun"


def test_a_ball_inside_a_ball_is_unseen(context: Context) -> None:
    """What is hidden does not change what hides it by more than what is near it weighs."""
    frame, inner = sky_with_sun(60, 35, size=SIZE), {**BALL, "scale": [0.3, 0.3, 0.3]}
    alone, both = (finite_picture(context, frame, scene(*items)) for items in ([BALL], [BALL, inner]))
    u, v = uv_from_direction(np.array([0.1, -0.9, -2.55])) * SIZE
    assert both[int(v), int(u)] == pytest.approx(alone[int(v), int(u)], rel=0.1)


@pytest.mark.parametrize("elevation", [0.0, -0.5, 1.2, 90.0, -90.0, -45.0])
@pytest.mark.parametrize("radius", [1e-6, 0.0047, 0.15])
def test_lights_at_the_horizon_and_at_the_poles(context: Context, elevation: float, radius: float) -> None:
    light = lit_by(Light(direction(30, elevation), np.full(3, 4.0), radius, id=1))
    finite_picture(context, sky_with_sun(60, 35, size=SIZE), scene(*SCENES["touching"]), light)


def test_a_light_under_the_ground_gives_the_ground_nothing(context: Context) -> None:
    frame = sky_with_sun(60, 35, size=SIZE)
    below = finite_picture(context, frame, scene(BALL), lit_by(Light(direction(30, -60), np.full(3, 4.0), 0.01, id=1)))
    none = finite_picture(context, frame, scene(BALL), lit_by())
    u, v = (uv_from_direction(np.array([[0.7, -1.6, -3.2], [-0.7, -1.6, -3.2], [0, -1.6, -2.2]])) * SIZE).T.astype(int)
    assert below[v, u] == pytest.approx(none[v, u], abs=1e-3)


def test_no_lights_at_all(context: Context) -> None:
    picture = finite_picture(context, sky_with_sun(60, 35, size=SIZE), scene(*SCENES["touching"]), lit_by())
    u, v = uv_from_direction(np.array([0, -0.7, -2.7])) * SIZE      # the ball's upper front
    assert picture[int(v), int(u)] == pytest.approx(0.3 * 0.8, rel=0.25)


def test_eight_lights_of_which_four_may_be_hidden(context: Context) -> None:
    lights = tuple(Light(direction(45 * i, 20), np.full(3, 1.0), 0.02, id=i) for i in range(8))
    finite_picture(context, sky_with_sun(60, 35, size=SIZE), scene(*SCENES["touching"]), lit_by(*lights))


@pytest.mark.parametrize("name", ["touching", "flat boxes"])
def test_a_black_frame_stays_black(context: Context, name: str) -> None:
    picture = finite_picture(context, RadianceFrame(np.zeros((128, 256, 3), np.float32)), scene(*SCENES[name]))
    assert picture.max() == 0.0


def test_objects_of_which_none_throws_a_shadow(context: Context) -> None:
    frame = sky_with_sun(60, 35, size=SIZE)
    items = [{**item, "casts_shadow": False} for item in SCENES["touching"]]
    picture = finite_picture(context, frame, scene(*items))
    assert (picture != frame.rgb).any()
    u, v = uv_from_direction(np.array([-1.4, -1.6, -3.2])) * SIZE
    assert (picture[int(v), int(u)] == frame.rgb[int(v), int(u)]).all()


def test_views_of_ever_other_sizes_do_not_pile_up(context: Context, monkeypatch: pytest.MonkeyPatch) -> None:
    """A long live event: things of all sizes come and go, a rough specular floor among them."""
    monkeypatch.setattr(surfaces, "MAX_IDLE_PIXELS", 50_000)       # a quarter of what comes together here
    pipeline = Pipeline(context, RadianceFrame, (1024, 512))
    frame = sky_with_sun(30, 50, size=(1024, 512))
    light, _ = pipeline.analyse(frame)
    random = np.random.default_rng(3)
    for _ in range(60):
        size = 10 ** random.uniform(-1.0, 0.5)
        item = {"id": "o", "mesh": "box", "position": [*random.uniform(-2, 2, 2), -2.5 - size], "scale": [size, size / 2, size]}
        document = {"objects": [item], "ground": {"specular": float(random.choice([0.0, 0.3])), "roughness": 0.9}}
        rendered = pipeline.render(frame, Scene.model_validate(document), light=light)
        assert isinstance(rendered.frame, RadianceFrame)
        assert np.isfinite(rendered.frame.rgb).all()
    targets = [target for group in pipeline._surfaces._targets.values() for target in group]
    assert sum(target.pixels for target in targets if target.view is None) <= 50_000
    pipeline.release()


def test_a_rough_floor_around_the_camera_has_views_that_fit_a_framebuffer(context: Context) -> None:
    pipeline = Pipeline(context, RadianceFrame, SIZE)
    document = {"camera_height": 1.0, "ground": {"specular": 0.3, "roughness": 0.75},
                "objects": [{"id": "o", "mesh": "box", "position": [0, 0.5, -1.5], "scale": [6, 0.2, 0.6]}]}
    pipeline.render(sky_with_sun(30, 50, size=SIZE), Scene.model_validate(document))
    assert pipeline.placement is not None
    views = pipeline.placement.mirrored
    pipeline.release()
    assert len(views) > 1       # too wide for one
    assert max(side for view in views for side in view.size) < 4 * SIZE[1]

"""Light that objects keep from themselves and each other, in the picture."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import moderngl
import numpy as np
import pytest

from renderer.equirectangular import uv_from_direction
from renderer.frame import RadianceFrame
from renderer.gl import Context
from renderer.light.detection import Detection, Light
from renderer.light.reading import FrameLight
from renderer.pipeline import Pipeline
from renderer.scene import Scene
from renderer.shadows.light_visibility import LightVisibilityStage
from tests.renderer.frames import direction, scene, sky_with_sun

MATTE = {"base_color": [0.8, 0.8, 0.8], "roughness": 1.0}
BALL = {"mesh": "sphere", "position": [0, -0.5, -3], "material": MATTE}
WALL = {"mesh": "box", "position": [1.5, 0.0, -3], "scale": [0.1, 2.5, 2.0], "material": MATTE}
Drawn = Callable[..., tuple[np.ndarray, list[bool]]]


@pytest.fixture
def drawn(context: Context, monkeypatch: pytest.MonkeyPatch) -> Drawn:
    """Renders objects without a ground: the red channel, and for each view whether light is hidden in it."""
    hidden: list[bool] = []
    original = LightVisibilityStage.texture

    def watched(stage: LightVisibilityStage, *arguments: Any) -> tuple[moderngl.Texture, int]:
        texture, number = original(stage, *arguments)
        hidden.append(texture is not stage.all_visible)
        return texture, number

    monkeypatch.setattr(LightVisibilityStage, "texture", watched)

    def draw(wanted: Scene, frame: RadianceFrame, light: FrameLight | None = None) -> tuple[np.ndarray, list[bool]]:
        hidden.clear()
        pipeline = Pipeline(context, RadianceFrame, frame.size)
        rendered = pipeline.render(frame, wanted, light=light)
        pipeline.release()
        assert rendered.errors == {}
        assert isinstance(rendered.frame, RadianceFrame)
        return rendered.frame.rgb[..., 0], list(hidden)

    return draw


def objects(*items: dict[str, Any]) -> Scene:
    return scene(*items, ground={"catcher": False})


def value_at(picture: np.ndarray, point: Any) -> float:
    u, v = uv_from_direction(np.array(point, dtype=float)) * picture.shape[::-1]
    return float(picture[int(v), int(u)])


def lit_by(light: Light, sky: float = 0.0) -> FrameLight:
    """A flat sky with one light."""
    flat = np.full((32, 64, 3), sky)
    return FrameLight(Detection((light,), flat, flat, 0.0), np.zeros((25, 3)), flat.astype(np.float32),
                      (np.pi * flat).astype(np.float32))


LIT_SIDE = np.array([0, -0.5, -3]) + 0.5 * direction(90, 20) * 0.6 + 0.5 * np.array([0, 0, 0.8])    # of the ball, and seen


def test_a_wall_keeps_the_sun_from_what_is_behind_it(drawn: Drawn) -> None:
    frame = sky_with_sun(90, 20, sun=4000.0)
    free, _ = drawn(objects(BALL), frame)
    shaded, hidden = drawn(objects(BALL, WALL), frame)
    assert True in hidden
    sun = 4000 * np.sin(np.radians(2.0)) ** 2 * 0.6     # over pi
    assert value_at(free, LIT_SIDE) == pytest.approx(0.8 * (sun + 0.5), rel=0.15)
    assert value_at(shaded, LIT_SIDE) < 0.8 * 0.5 * 1.1
    assert value_at(shaded, LIT_SIDE) > 0.2 * 0.5


def test_what_throws_no_shadow_hides_nothing(drawn: Drawn) -> None:
    frame = sky_with_sun(90, 20, sun=4000.0)
    free, _ = drawn(objects(BALL), frame)
    found, hidden = drawn(objects({**BALL, "casts_shadow": False}, {**WALL, "casts_shadow": False}), frame)
    assert True not in hidden
    assert value_at(found, LIT_SIDE) == pytest.approx(value_at(free, LIT_SIDE), rel=0.1)


@pytest.mark.parametrize("mesh", ["sphere", "box", "cylinder"])
@pytest.mark.parametrize("elevation", [5, 60])
def test_a_convex_object_alone_needs_no_depth_map(drawn: Drawn, mesh: str, elevation: float) -> None:
    _, hidden = drawn(objects({**BALL, "mesh": mesh}), sky_with_sun(60, elevation))
    assert hidden
    assert True not in hidden


def test_a_teapot_hides_the_sun_from_itself(drawn: Drawn) -> None:
    _, hidden = drawn(objects({"mesh": "teapot", "position": [0, -1, -3], "material": MATTE}), sky_with_sun(60, 40))
    assert True in hidden


@pytest.mark.parametrize("mesh", ["box", "sphere", "cylinder"])
def test_what_shades_another_object_does_not_shade_its_own_lit_side(drawn: Drawn, mesh: str) -> None:
    """It is in the depth map, and lies at the depth that is there."""
    front = {"mesh": mesh, "position": [0, 0, -2], "scale": [0.5, 0.5, 0.5], "material": MATTE}
    behind = {"mesh": "box", "position": [0, -0.4, -3], "scale": [2, 2, 0.2], "material": MATTE}
    frame = sky_with_sun(150, 35, sun=4000.0)
    alone, _ = drawn(objects(front), frame)
    both, hidden = drawn(objects(front, behind), frame)
    assert True in hidden
    u, v = (np.array([256, 128]) + np.mgrid[-6:7, -6:7].reshape(2, -1).T).T    # +-4 degrees; the object covers 14
    lit = alone[v, u] > 1.2     # not at the terminator
    assert lit.mean() > 0.4
    # what is near it weighs a little on the sky's light
    assert both[v, u][lit] == pytest.approx(alone[v, u][lit], rel=0.08)


@pytest.mark.parametrize(("height", "radius_deg"), [(0.4, 8.0), (0.6, 4.0), (0.8, 7.0)])
def test_the_penumbra_of_an_edge_is_as_wide_as_the_disc_is_from_there(drawn: Drawn, height: float, radius_deg: float) -> None:
    """A lamp overhead, half of a table under a board: over x / (h tan r) the share is that of a disc behind an edge."""
    table = {"mesh": "box", "position": [-1.2, -1.1, -1.6], "scale": [2.0, 0.2, 1.2], "material": MATTE}
    board = {"mesh": "box", "position": [-2.2, -1.0 + height + 0.01, -1.6], "scale": [2.0, 0.02, 2.4], "material": MATTE}
    lamp = Light(np.array([0.0, 1.0, 0.0]), np.full(3, 3.0), np.radians(radius_deg), id=1)
    picture, hidden = drawn(objects(table, board), RadianceFrame(np.zeros((512, 1024, 3), np.float32)), lit_by(lamp))
    assert True in hidden
    x = np.linspace(-0.3, 0.3, 121)
    values = np.array([value_at(picture, [one - 1.2, -1.0, -1.6]) for one in x])
    assert values[0] == pytest.approx(0.0, abs=0.02)
    share = values / values[-20:].mean()
    assert values[-1] > 0.5

    def profile(half_width: float) -> np.ndarray:
        t = np.clip(x / half_width, -1, 1)
        return np.asarray(0.5 + (t * np.sqrt(1 - t * t) + np.arcsin(t)) / np.pi)

    widths = np.linspace(0.01, 0.3, 200)
    best = widths[np.argmin([np.sum((profile(width) - share) ** 2) for width in widths])]
    assert best == pytest.approx(height * np.tan(np.radians(radius_deg)), rel=0.15)


@pytest.mark.parametrize("position", [[0, -0.5, 1.5], [4.5, 1.5, -3], [0, 2.5, -3]])
def test_nothing_is_drawn_for_what_cannot_be_in_the_way(drawn: Drawn, position: list[float]) -> None:
    _, hidden = drawn(objects(BALL, {**BALL, "position": position}), sky_with_sun(-90, 10, radius_deg=1.0))
    assert hidden
    assert True not in hidden


def test_what_lies_in_the_shadow_is_the_only_one_that_needs_a_depth_map(drawn: Drawn) -> None:
    behind = [3.0, -0.5 - 3 * np.tan(np.radians(10)), -3]
    _, hidden = drawn(objects(BALL, {**BALL, "position": behind}), sky_with_sun(-90, 10, radius_deg=1.0))
    assert sorted(hidden) == [False, True]


@pytest.mark.parametrize(("share", "is_hidden"), [(0.01, False), (0.1, True)])
def test_a_light_that_gives_next_to_nothing_goes_through(drawn: Drawn, share: float, is_hidden: bool) -> None:
    """The wall stands on the weak light's side, and the strong one's way is free."""
    post = {**WALL, "position": [1.2, -0.4, -3], "scale": [0.1, 0.5, 0.5]}
    lights = (Light(direction(180, 20), np.full(3, 5.0), 0.02, id=1), Light(direction(90, 5), np.full(3, 5 * share), 0.02, id=2))
    flat = np.full((32, 64, 3), 0.5)
    light = FrameLight(Detection(lights, flat, flat, 0.0), np.zeros((25, 3)), flat.astype(np.float32),
                       np.full((32, 64, 3), np.pi / 2, np.float32))
    _, hidden = drawn(objects(BALL, post), sky_with_sun(90, 20), light)
    assert (True in hidden) == is_hidden


def test_what_is_drawn_stays_until_light_or_objects_move(context: Context, monkeypatch: pytest.MonkeyPatch) -> None:
    added = []
    original = LightVisibilityStage._add
    monkeypatch.setattr(LightVisibilityStage, "_add", lambda stage, *a: (added.append(1), original(stage, *a)))
    pipeline, frame = Pipeline(context, RadianceFrame, (256, 128)), sky_with_sun(90, 20, size=(256, 128))

    def drawings(wanted: Scene, azimuth: float) -> int:
        added.clear()
        pipeline.render(frame, wanted, light=lit_by(Light(direction(azimuth, 20), np.full(3, 5.0), np.radians(2), id=1), sky=0.5))
        return len(added)

    post = {**WALL, "position": [1.2, -0.4, -3], "scale": [0.1, 1.0, 0.5]}
    wanted = objects(BALL, post)
    assert [drawings(wanted, azimuth) for azimuth in (90.0, 90.0, 90.2, 90.4)] == [1, 0, 0, 0]
    assert drawings(wanted, 92.0) == 1
    moved = objects(BALL, {**post, "position": [1.1, -0.4, -3]})
    assert [drawings(moved, 92.0), drawings(moved, 92.0)] == [1, 0]
    pipeline.release()


def test_each_light_has_its_own_shadows(drawn: Drawn) -> None:
    """The wall hides one of two lights from the ball; which of them is the stronger makes no difference."""
    flat = RadianceFrame(np.zeros((256, 512, 3), np.float32))

    def shown(*lights: Light) -> np.ndarray:
        black = np.zeros((32, 64, 3))
        light = FrameLight(Detection(lights, black, black, 0.0), np.zeros((25, 3)), black.astype(np.float32),
                           black.astype(np.float32))
        return drawn(objects(BALL, WALL), flat, light)[0]

    behind_wall = Light(direction(90, 10), np.full(3, 5.0), np.radians(1), id=1)
    free = Light(direction(180, 10), np.full(3, 4.0), np.radians(1), id=2)
    one_by_one = shown(behind_wall) + shown(free)
    assert np.abs(one_by_one).max() > 0.5
    assert shown(behind_wall, free) == pytest.approx(one_by_one, abs=0.01)
    assert shown(free, behind_wall) == pytest.approx(one_by_one, abs=0.01)


@pytest.mark.parametrize("elevation", [36, 42])
def test_a_shadows_edge_lies_where_the_rays_that_graze_the_caster_end(drawn: Drawn, elevation: float) -> None:
    """However coarse the depth map is: something far away widens what it has to cover."""
    height, edge = 0.3, -1.2
    table = {"mesh": "box", "position": [-1.4, -1.1, -1.6], "scale": [1.6, 0.2, 1.2], "material": MATTE}
    board = {"mesh": "box", "position": [edge - 1.0, -1.0 + height + 0.01, -1.6], "scale": [2.0, 0.02, 2.4], "material": MATTE}
    far = {"mesh": "box", "position": [1.6, -1.1, -1.6], "scale": [0.2, 0.2, 0.2], "material": MATTE}
    lamp = Light(direction(90, elevation), np.full(3, 5.0), np.radians(0.3), id=1)
    frame = RadianceFrame(np.zeros((1024, 2048, 3), np.float32))
    picture, _ = drawn(objects(table, board, far), frame, lit_by(lamp))
    expected = edge - height / np.tan(np.radians(elevation))
    x = np.linspace(expected - 0.08, expected + 0.08, 161)
    values = np.array([value_at(picture, [one, -1.0, -1.2]) for one in x])
    assert values[0] < 0.1 * values[-1]
    assert x[np.argmax(values > 0.5 * values[-1])] == pytest.approx(expected, abs=0.012)

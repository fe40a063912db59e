"""Objects in a specular ground: where, how bright, how wide; what hides them; and that none of it costs anything without."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from renderer.equirectangular import uv_from_direction
from renderer.frame import Frame, RadianceFrame, YuvFrame
from renderer.gl import Context
from renderer.pipeline import Pipeline
from renderer.scene import Scene
from tests.renderer.frames import direction, noise_frame, scene, sky_with_sun

SIZE = (512, 256)
HEIGHT = 1.6
GLOW: dict[str, Any] = {"base_color": [0, 0, 0], "metallic": 1, "roughness": 1, "emissive": [1, 1, 1]}


def glowing(position: tuple[float, float, float], size: float = 0.4, emissive: float = 1.0) -> dict[str, Any]:
    return {"mesh": "sphere", "position": position, "scale": [size] * 3, "casts_shadow": False,
            "material": GLOW | {"emissive": [emissive] * 3}}


def floor_scene(*objects: dict[str, Any], specular: float, roughness: float = 0.0, **values: Any) -> Scene:
    return scene(*objects, ground={"specular": specular, "roughness": roughness}, camera_height=HEIGHT, **values)


def uniform(value: float) -> RadianceFrame:
    return RadianceFrame(np.full((SIZE[1], SIZE[0], 3), value, np.float32))


def rendered(context: Context, frame: Frame, *scenes: Scene) -> Frame:
    """The frame with the last scene, after the others."""
    pipeline = Pipeline(context, type(frame), frame.size)
    try:
        return [pipeline.render(frame, one).frame for one in scenes][-1]
    finally:
        pipeline.release()
        context.collect()


def radiance(context: Context, frame: Frame, *scenes: Scene) -> np.ndarray:
    result = rendered(context, frame, *scenes)
    assert isinstance(result, RadianceFrame)
    return result.rgb[..., 1].astype(np.float64)


def centroid(picture: np.ndarray) -> np.ndarray:
    rows, columns = np.mgrid[0:picture.shape[0], 0:picture.shape[1]] + 0.5
    return np.array([(columns * picture).sum(), (rows * picture).sum()]) / picture.sum()


def mirrored(position: tuple[float, float, float]) -> np.ndarray:
    """Where the ground shows a place, in pixels."""
    x, y, z = position
    return np.asarray(uv_from_direction(np.array([x, -2 * HEIGHT - y, z])) * SIZE)


@pytest.mark.parametrize("position", [(0.0, 0.3, -4.0), (3.0, -0.8, -1.5), (-1.0, -1.2, 2.0)])
def test_the_image_lies_where_a_mirror_shows_it_and_is_as_bright(context: Context, position: tuple[float, float, float]) -> None:
    frame, item = uniform(0.0), glowing(position)
    picture = radiance(context, frame, floor_scene(item, specular=1.0)) - radiance(context, frame, floor_scene(item, specular=0.0))
    assert centroid(picture) == pytest.approx(mirrored(position), abs=0.5)
    column, row = mirrored(position).astype(int)
    assert picture[row - 1:row + 2, column - 1:column + 2] == pytest.approx(1.0, abs=0.01)
    # as large as a sphere at the distance of the mirror image
    x, y, z = position
    rows = (np.arange(SIZE[1]) + 0.5) / SIZE[1] * np.pi
    solid_angle = (picture * np.sin(rows)[:, None]).sum() * 2 * np.pi**2 / (SIZE[0] * SIZE[1])
    half = np.arcsin(0.2 / np.hypot(np.hypot(x, z), 2 * HEIGHT + y))
    assert solid_angle == pytest.approx(2 * np.pi * (1 - np.cos(half)), rel=0.05)


@pytest.mark.parametrize(("height", "elevation"), [(3.0, -89.0), (-0.6, -60.0), (-0.6, -30.0), (-0.6, -12.0)])
def test_the_image_is_weighed_by_schlicks_reflectance(context: Context, height: float, elevation: float) -> None:
    towards = direction(20, elevation) * (2 * HEIGHT + height) / np.sin(np.radians(-elevation))
    item = glowing((float(towards[0]), height, float(towards[2])), 0.6)
    column, row = mirrored(item["position"]).astype(int)
    picture = radiance(context, uniform(0.0), floor_scene(item, specular=0.5))
    expected = 0.5 + 0.5 * (1 - np.sin(np.radians(-elevation)))**5
    assert picture[row, column] == pytest.approx(expected, abs=0.01)


@pytest.mark.parametrize("roughness", [0.0, 0.5])
def test_what_is_as_bright_as_the_world_changes_nothing(context: Context, roughness: float) -> None:
    for specular in (0.3, 1.0):
        picture = radiance(context, uniform(1.0), floor_scene(glowing((0, -0.9, -3), 0.8), specular=specular, roughness=roughness))
        assert np.abs(picture - 1).max() < 0.005


def test_the_floor_no_longer_shows_what_the_object_hides(context: Context) -> None:
    """A black object over a floor that mirrors all: as black."""
    frame = uniform(1.0)
    position = (0.0, -0.4, -3.0)
    picture = radiance(context, frame, floor_scene(glowing(position, emissive=0.0), specular=1.0))
    column, row = mirrored(position).astype(int)
    assert picture[row, column] == pytest.approx(0.0, abs=0.01)


@pytest.mark.parametrize("roughness", [0.0, 0.3])
def test_a_floor_too_dark_for_its_reflectance_gets_no_holes(context: Context, roughness: float) -> None:
    frame = uniform(1.0)
    frame.rgb[SIZE[1] // 2:] = 0.1
    position = (0.0, -0.4, -3.0)
    column, row = mirrored(position).astype(int)
    item = glowing(position, emissive=0.0)
    assert radiance(context, frame, floor_scene(item, specular=0.5, roughness=roughness))[row, column] > 0.07
    # one that may well be that specular loses what it showed
    found = radiance(context, frame, floor_scene(item, specular=0.02))[row, column]
    assert found == pytest.approx(0.1 - 0.02 - 0.98 * (1 - 2.8 / np.hypot(2.8, 3))**5, abs=0.002)


def test_roughness_widens_the_image_and_keeps_its_sum(context: Context) -> None:
    position = (0.0, -0.3, -3.0)
    item = glowing(position)
    frame = uniform(0.0)
    plain = radiance(context, frame, floor_scene(item, specular=0.0))
    rows = np.arange(SIZE[1])[:, None] + 0.5
    pictures = [(radiance(context, frame, floor_scene(item, specular=1.0, roughness=roughness)) - plain)
                * np.sin(rows / SIZE[1] * np.pi) for roughness in (0.0, 0.2, 0.4)]      # by solid angle
    widths = [np.sqrt(((rows - centroid(one)[1])**2 * one).sum() / one.sum()) for one in pictures]
    assert widths[0] < widths[1] < widths[2]
    spread = np.sqrt(2) * 0.4**2 * (1.3 / 2.9) * SIZE[1] / np.pi      # of the way 1.3 m of 2.9 lie behind the floor, by height
    assert np.sqrt(widths[2]**2 - widths[0]**2) == pytest.approx(spread, rel=0.2)
    for picture in pictures[1:]:
        assert picture.sum() == pytest.approx(pictures[0].sum(), rel=0.1)
        assert centroid(picture) == pytest.approx(centroid(pictures[0]), abs=3)     # of 7 that it is wide


def test_the_image_is_sharp_where_the_object_stands(context: Context) -> None:
    box = {"mesh": "box", "position": (0, -HEIGHT + 1, -3), "scale": (0.4, 2, 0.4), "casts_shadow": False, "material": GLOW}
    frame = uniform(0.0)
    plain = radiance(context, frame, floor_scene(box, specular=0.0))
    picture = radiance(context, frame, floor_scene(box, specular=1.0, roughness=0.4)) - plain
    slopes = []
    for height in (0.15, 1.5):
        row = int(uv_from_direction(np.array([0, -HEIGHT - height, -2.8]))[1] * SIZE[1])
        slopes.append(np.abs(np.diff(picture[row])).max() / picture[row].max())
    assert slopes[0] > 1.8 * slopes[1]


def test_an_object_in_front_hides_the_image(context: Context) -> None:
    position = (0.0, 0.0, -4.0)
    column, row = mirrored(position).astype(int)
    ground = np.array([0, -HEIGHT, -2.0])
    screen = {"mesh": "box", "position": tuple(ground * 0.5), "scale": (0.6, 0.6, 0.02), "casts_shadow": False,
              "material": GLOW | {"emissive": [0, 0, 0]}}
    frame = uniform(0.0)
    item = glowing(position, 0.5)
    assert radiance(context, frame, floor_scene(item, specular=1.0))[row, column] > 0.9
    assert radiance(context, frame, floor_scene(item, screen, specular=1.0))[row, column] < 0.05
    assert radiance(context, frame, floor_scene(item, screen, specular=0.0))[row, column] < 0.05


def test_a_real_thing_hides_the_image(context: Context) -> None:
    position = (0.0, 0.0, -4.0)
    column, row = mirrored(position).astype(int)
    item = glowing(position, 0.5)
    thing = {"id": "thing", "mesh": "box", "role": "occluder", "position": (0.0, -HEIGHT / 2, -1.0), "scale": (0.6, 0.6, 0.02)}
    assert radiance(context, uniform(0.0), floor_scene(item, specular=1.0, local_scene=[thing]))[row, column] < 0.05


def test_the_nearer_of_two_images_hides_the_other(context: Context) -> None:
    near, far = glowing((0, -1.2, -2), 0.4, 2.0), glowing((0, 0.8, -4), 1.2, 5.0)
    column, row = mirrored(near["position"]).astype(int)
    for order in ((near, far), (far, near)):
        picture = radiance(context, uniform(0.0), floor_scene(*order, specular=1.0))
        assert picture[row, column] == pytest.approx(2.0, abs=0.05)


def test_an_object_is_lit_as_it_is_in_front_of_the_mirror(context: Context) -> None:
    """The sun shines on its upper side, which a floor below does not show."""
    frame = sky_with_sun(0, 60, sky=0.1, sun=2000)
    ball = {"mesh": "sphere", "position": (0, -0.5, -2.5), "scale": (0.8, 0.8, 0.8), "casts_shadow": False,
            "material": {"base_color": [0.8, 0.8, 0.8], "roughness": 1}}
    plain = radiance(context, frame, floor_scene(ball, specular=0.0))
    change = radiance(context, frame, floor_scene(ball, specular=1.0)) - plain
    column, row = mirrored(ball["position"]).astype(int)
    lower = mirrored((0, -0.5 + 0.3, -2.5))[1]
    assert abs(change[row, column]) > 0.01
    assert change[int(lower), column] > change[row, column]       # its side turned to the sun is at the bottom of the image


@pytest.mark.parametrize("roughness", [0.0, 0.3])
def test_video_shows_the_same_as_radiance(context: Context, roughness: float) -> None:
    frame = noise_frame(SIZE, seed=2)
    wanted = floor_scene(glowing((0, -0.9, -3), 0.8, 3.0), specular=0.6, roughness=roughness)
    result = rendered(context, frame, wanted)
    plain = rendered(context, frame, floor_scene(glowing((0, -0.9, -3), 0.8, 3.0), specular=0.0, roughness=roughness))
    assert isinstance(result, YuvFrame)
    assert isinstance(plain, YuvFrame)
    changed = result.y != plain.y
    column, row = mirrored((0, -0.9, -3)).astype(int)
    assert changed[row - 3:row + 4, column - 3:column + 4].mean() > 0.9
    assert not changed[:SIZE[1] // 2].any()
    brighter = result.y[row - 3:row + 4, column - 3:column + 4].astype(int) - plain.y[row - 3:row + 4, column - 3:column + 4]
    assert brighter.mean() > 20


def test_images_all_around_are_whole(context: Context) -> None:
    """Wider than a view can be: each at its place, as bright and as large as alone."""
    angles = np.arange(12) * 2 * np.pi / 12
    ring = [glowing((5 * np.sin(a), -0.5, -5 * np.cos(a)), 2.5) for a in angles]
    frame = uniform(0.0)
    pipeline = Pipeline(context, RadianceFrame, SIZE)
    together = pipeline.render(frame, floor_scene(*ring, specular=1.0)).frame
    assert pipeline.placement is not None
    assert len({view.members for view in pipeline.placement.mirrored}) == 1     # not a view for each
    assert len(pipeline.placement.mirrored) > 2
    pipeline.release()
    alone = np.max([radiance(context, frame, floor_scene(item, specular=1.0)) for item in ring], axis=0)
    difference = np.abs(np.asarray(together.rgb[..., 1], dtype=np.float64) - alone)
    assert difference.max() < 0.6       # edges, by samples that lie elsewhere
    assert (difference > 0.1).sum() < 0.1 * (alone > 0).sum()
    assert difference.mean() < 0.01


def test_moving_objects_take_their_images_along(context: Context) -> None:
    frame = uniform(0.0)
    scenes = [floor_scene(glowing((x, -0.6, -3.0)), specular=1.0, roughness=0.2) for x in (-0.5, 0.0, 0.7)]
    assert (radiance(context, frame, *scenes) == radiance(context, frame, scenes[-1])).all()


def test_a_floor_that_is_not_specular_costs_nothing(context: Context, monkeypatch: pytest.MonkeyPatch) -> None:
    compiled: list[str] = []
    compile_program = Context.program

    def counted(self: Context, vertex: str, fragment: str, defines: Any = None) -> Any:
        compiled.append(f"{fragment} {(defines or {}).get('FLOOR', 0)}")
        return compile_program(self, vertex, fragment, defines)

    monkeypatch.setattr(Context, "program", counted)
    frame = sky_with_sun(0, 60)
    item = {"mesh": "sphere", "position": (0, -0.9, -3)}
    pictures = [radiance(context, frame, scene(item, ground=ground, camera_height=HEIGHT)) for ground in (
        {}, {"specular": 0.0, "roughness": 0.9}, {"catcher": False, "specular": 1.0}, {"catcher": False})]
    assert (pictures[0] == pictures[1]).all()
    assert (pictures[2] == pictures[3]).all()
    assert not any(name.startswith("floor") or name.endswith(" 1") for name in compiled)
    radiance(context, frame, scene(item, ground={"specular": 1.0, "roughness": 0.5}, camera_height=HEIGHT))
    assert {"floor_blur.frag.glsl 0", "floor_distance.frag.glsl 0", "composite.frag.glsl 1"} <= set(compiled)

"""Compositing in the planes by kept layers: as OpenGL does it, and never from a layer that no longer holds."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from renderer.color import YuvFormat, linear_from_srgb, srgb_from_linear
from renderer.frame import YuvFrame
from renderer.gl import Context
from renderer.light.inverse_tone_mapping import linear_from_radiance, radiance_from_linear
from renderer.light.radiance_map import RadianceMapStage, Way
from renderer.native import kernels
from renderer.pipeline import Pipeline
from renderer.scene import Scene
from tests.renderer.frames import scene, sky_with_sun, yuv_from_linear

SIZE = (512, 256)
BALL = {"mesh": "sphere", "position": [0.3, -1.1, -3], "material": {"base_color": [0.8, 0.3, 0.1], "roughness": 0.6}}
METAL = {"mesh": "cylinder", "position": [-1.2, -1.1, -2.4], "material": {"metallic": 1.0, "roughness": 0.3}}
MIRROR = {"mesh": "sphere", "position": [1.3, -1.1, -2.2], "material": {"metallic": 1.0, "roughness": 0.0}}
BEHIND = {"mesh": "box", "position": [0, -1.1, 3.0], "material": {"base_color": [0.2, 0.7, 0.2]}}
TABLE = {"id": "table", "mesh": "box", "position": [0, -1.3, -2.5], "scale": [2, 0.1, 1], "role": "catcher"}
PAPER = {"preset": "paper"}


def outdoors(azimuth: float = 70.0, size: tuple[int, int] = SIZE, layout: YuvFormat | None = None) -> YuvFrame:
    """A textured frame with a sun in it."""
    radiance = sky_with_sun(azimuth, 45.0, size=size).rgb * np.random.default_rng(1).uniform(0.6, 1.4, (size[1], size[0], 1))
    return yuv_from_linear(linear_from_radiance(radiance), layout)


def planes(frame: object) -> Iterator[np.ndarray]:
    assert isinstance(frame, YuvFrame)
    return iter((frame.y, frame.u, frame.v))


@pytest.fixture(autouse=True)
def _layers_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("renderer.pipeline.STEADY_FRAMES", 0)


@pytest.fixture
def pipeline(context: Context) -> Iterator[Pipeline]:
    made = Pipeline(context, YuvFrame, SIZE)
    assert made._kept is not None, "renderer/native is not built, or the renderer is no software renderer"
    yield made
    made.release()
    context.collect()


def both_ways(pipeline: Pipeline, frame: YuvFrame, wanted: Scene) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Planes by kept layers, and by OpenGL, under the same light."""
    kept = pipeline.render(frame, wanted)
    found = [plane.copy() for plane in planes(kept.frame)]
    layers, pipeline._kept = pipeline._kept, None
    drawn = pipeline.render(frame, wanted, light=kept.light)
    pipeline._kept = layers
    return found, list(planes(drawn.frame))


@pytest.mark.parametrize("wanted", [
    scene(BALL, METAL), scene(BALL, BEHIND), scene(BALL, METAL, lighting=PAPER), scene(BALL, local_scene=[TABLE]),
    scene({**BALL, "material": {"emissive": [40, 5, 0]}}), scene(BALL, ground={"specular": 0.3})],
    ids=["ground", "seam", "additive", "catcher", "emissive", "specular floor"])
def test_as_opengl_composites(pipeline: Pipeline, wanted: Scene) -> None:
    for layout in (YuvFormat("bt709", False), YuvFormat("bt601", True)):
        assert_alike(*both_ways(pipeline, outdoors(layout=layout), wanted))


@pytest.mark.parametrize("size", [(516, 258), (258, 130), (1922, 962)])
def test_frames_that_are_no_whole_tiles(context: Context, size: tuple[int, int]) -> None:
    pipeline, frame = Pipeline(context, YuvFrame, size), outdoors(size=size)
    found, expected = both_ways(pipeline, frame, scene({**BALL, "position": [0.2, -1.1, 1.2], "scale": [1.5] * 3}, METAL))
    pipeline.release()
    assert (found[0] != frame.y).mean() > 0.02
    assert_alike(found, expected)


def assert_alike(found: list[np.ndarray], expected: list[np.ndarray]) -> None:
    """The residual's shadow is looked up once for four pixels by OpenGL, once for each here: near contacts that is seen."""
    for one, other in zip(found, expected, strict=True):
        difference = np.abs(one.astype(int) - other.astype(int))
        assert (difference > 1).mean() < 0.002
        assert difference.max() <= 6


@pytest.mark.parametrize("width", [512, 2048])
def test_mirrors_show_what_opengl_shows(context: Context, width: int) -> None:
    """A small ball, in which most of the frame comes from the small map, and a large box near by, where it comes from the frame's
    pixels; the frame has colours and edges, and changes under a light that stays."""
    size = (width, width // 2)
    pipeline = Pipeline(context, YuvFrame, size)
    box = {"mesh": "box", "position": [-1.1, -0.6, -1.3], "scale": [0.8] * 3, "rotation": [0, 0.38268, 0, 0.92388],
           "material": {"metallic": 1.0, "roughness": 0.0, "base_color": [0.9, 0.7, 0.5]}}
    wanted = scene(MIRROR, box, BALL)
    both_ways(pipeline, patches(size, 0.0), wanted)
    for turn in (0.0, 1.0):
        frame = patches(size, turn)
        found, expected = both_ways(pipeline, frame, wanted)
        shown = np.abs(expected[0].astype(int) - frame.y) > 2
        assert shown.mean() > 0.03
        for one, other in zip(found, expected, strict=True):
            difference = np.abs(one.astype(int) - other.astype(int))
            assert (difference > 4).sum() < 0.04 * shown.sum()
    pipeline.release()


def patches(size: tuple[int, int], turn: float) -> YuvFrame:
    """A coloured frame with broad edges, turned by so many radians."""
    v, u = np.mgrid[0:size[1], 0:size[0]] / np.array([size[1], size[0]])[:, None, None]
    waves = [np.tanh(3 * np.sin(3 * (2 * np.pi * u + turn) + shift) * np.sin(5 * np.pi * v + shift)) for shift in (0.0, 1.0, 2.0)]
    return yuv_from_linear(0.3 + 0.2 * np.stack(waves, axis=-1))


@pytest.mark.parametrize("additive", [False, True])
def test_the_kernel_against_float64(additive: bool) -> None:
    """Random codes and layers, two tiles of them at the edges of a frame that is no whole number of tiles."""
    random, size, across = np.random.default_rng(3), (40, 24), 3
    frame = yuv_from_linear(random.uniform(0, 1, (size[1], size[0], 3)), YuvFormat("bt601", True))
    store = np.zeros((6, 8, 16, 16), dtype=np.float16)
    store[:, :4] = random.uniform(0, 1, (6, 4, 16, 16))
    store[:, 4:7] = random.uniform(0, 1, (6, 3, 16, 16)) ** 4 * 12
    store[:, 7] = random.random((6, 16, 16)) < 0.7
    expected = reference(frame, store, across, additive)
    result = frame.copy()
    kernels.composite(result, store, np.array([1, 5], dtype=np.int32), across, additive=additive)
    inside = np.zeros((size[1], size[0]), dtype=bool)
    inside[:16, 16:32] = inside[16:, 32:] = True
    assert (result.y[~inside] == frame.y[~inside]).all()
    assert np.abs(result.y.astype(int) - np.where(inside, expected[0], frame.y)).max() <= 0.6
    for found, plane, before in ((result.u, expected[1], frame.u), (result.v, expected[2], frame.v)):
        mean = plane.reshape(12, 2, 20, 2).mean(axis=(1, 3))
        assert np.abs(found.astype(int) - np.where(inside[::2, ::2], mean, before)).max() <= 0.6


def reference(frame: YuvFrame, store: np.ndarray, across: int, additive: bool) -> np.ndarray:
    """(3, height, width) codes, not rounded."""
    height, width = frame.y.shape
    tiles = store.astype(float).reshape(-1, across, 8, 16, 16).transpose(2, 0, 3, 1, 4)
    layers = tiles.reshape(8, -1, across * 16)[:, :height, :width]
    factor, kept, added = np.moveaxis(layers[:3], 0, -1), layers[3][..., None], np.moveaxis(layers[4:7], 0, -1)
    codes = np.stack([frame.y, *(np.repeat(np.repeat(plane, 2, 0), 2, 1) for plane in (frame.u, frame.v))], axis=-1).astype(float)
    matrix = frame.format.rgb_from_yuv()
    linear = linear_from_srgb(np.clip(codes / 255 @ matrix[:, :3].T + matrix[:, 3], 0, 1))
    ground = np.maximum(radiance_from_linear(linear) - linear * factor, 0) if additive else radiance_from_linear(linear * factor)
    signal = srgb_from_linear(np.clip(linear_from_radiance(ground * kept + added), 0, 1))
    back = frame.format.yuv_from_rgb()
    new = np.clip(signal @ back[:, :3].T + back[:, 3], 0, 1) * 255
    return np.moveaxis(np.where(layers[7][..., None] > 0, new, codes), -1, 0)


@pytest.mark.parametrize("size", [(2048, 1024), (1280, 640), (3840, 1920)])
@pytest.mark.parametrize("layout", [YuvFormat("bt709", False), YuvFormat("bt601", True)])
def test_all_ways_of_reducing_agree(context: Context, size: tuple[int, int], layout: YuvFormat) -> None:
    pipeline, frame = Pipeline(context, YuvFrame, size), outdoors(size=size, layout=layout)
    pipeline._panorama.show(frame)
    stage = pipeline._radiance
    assert stage.way is Way.PROCESSOR
    found = stage.run()
    for way in (Way.FRAGMENT, Way.COMPUTE):
        other = RadianceMapStage(context, pipeline._panorama, way=way)
        expected = other.run()
        other.release()
        assert np.abs(found.rgb / expected.rgb - 1).max() < 1e-4
        assert np.abs(found.clipped - expected.clipped).max() < 1e-5
        assert expected.clipped.max() > 0.9
    pipeline.release()


@pytest.mark.parametrize("size", [(2048, 1024), (516, 258)])
def test_moments_by_the_processor_are_opengls(context: Context, size: tuple[int, int]) -> None:
    pipeline, frame = Pipeline(context, YuvFrame, size), outdoors(size=size)
    pipeline._panorama.show(frame)
    stage = pipeline._moments
    assert stage is not None
    assert stage._by_processor
    width, height = pipeline._radiance.size
    texels = np.random.default_rng(5).choice(width * height, 500, replace=False)
    found = stage.run(texels)
    stage._by_processor = False
    expected = stage.run(texels)
    pipeline.release()
    assert found == pytest.approx(expected, rel=5e-3, abs=1e-7)


def fresh(pipeline: Pipeline, frame: YuvFrame, wanted: Scene, **values: Any) -> list[np.ndarray]:
    """The planes with every layer drawn anew."""
    assert pipeline._kept is not None
    pipeline._kept._contents = {}
    return list(planes(pipeline.render(frame, wanted, **values).frame))


def test_no_layer_outlives_what_it_shows(pipeline: Pipeline) -> None:
    """Objects come, move, change and go, real things too, the sun jumps: after each step the layers that were kept are as good as
    new ones. Checked against a stale layer left in on purpose."""
    def moved(item: dict[str, Any], x: float) -> dict[str, Any]:
        return {**item, "position": [item["position"][0] + x, *item["position"][1:]]}

    scenes = [scene(BALL), scene(BALL, METAL), scene(moved(BALL, 0.2), METAL), scene(moved(BALL, 0.2), moved(METAL, -0.9), BEHIND),
              scene(METAL, BEHIND), scene({**METAL, "material": {"base_color": [0.1, 0.1, 0.9]}}, BEHIND),
              scene({**BALL, "casts_shadow": False}, METAL), scene(BALL, METAL, local_scene=[TABLE]),
              scene(BALL, METAL, MIRROR, local_scene=[{**TABLE, "role": "occluder"}]), scene(BALL, METAL, lighting=PAPER),
              scene(), scene(BALL, ground={"catcher": False}), scene(BALL, METAL, ground={"specular": 0.3}), scene(BALL, METAL)]
    frames = [outdoors(azimuth) for azimuth in (70.0, 75.0, -120.0)]
    changes = 0
    for step, wanted in enumerate(scenes):
        frame = frames[step % 3]
        light = pipeline.render(frame, wanted).light
        pipeline.render(frame, wanted, light=light)
        found = [plane.copy() for plane in planes(pipeline.render(frame, wanted, light=light).frame)]
        for one, other in zip(found, fresh(pipeline, frame, wanted, light=light), strict=True):
            assert (one == other).all(), f"step {step}"
        changes += (found[0] != frame.y).any()
    assert changes == len(scenes) - 1
    assert pipeline._kept is not None
    pipeline._kept._layers[:] *= 0.5
    stale = list(planes(pipeline.render(frame, wanted, light=light).frame))
    assert (stale[0] != found[0]).any()


def test_part_of_a_view_can_be_drawn_anew(pipeline: Pipeline) -> None:
    """Of what a view's objects cover, too: a shadow falls over one of its tiles."""
    wanted, frame = scene(BALL, METAL), outdoors()
    light = pipeline.render(frame, wanted).light
    assert pipeline._kept is not None
    kept = pipeline._kept
    found = [plane.copy() for plane in planes(pipeline.render(frame, wanted, light=light).frame)]
    contents = dict(kept._contents)
    for key in contents:        # as if each alone had been another
        kept._contents = {name: value for name, value in contents.items() if name != key}
        for one, other in zip(found, planes(pipeline.render(frame, wanted, light=light).frame), strict=True):
            assert (one == other).all(), str(key)


def test_only_what_is_another_is_drawn(pipeline: Pipeline, monkeypatch: pytest.MonkeyPatch) -> None:
    assert pipeline._kept is not None
    drawn: list[int] = []
    stage = pipeline._kept._stage
    layers = stage.layers
    monkeypatch.setattr(stage, "layers", lambda count: (drawn.append(count), layers(count))[1])
    far = scene(BALL, BEHIND)
    light = pipeline.render(outdoors(), far).light
    for _ in range(3):
        pipeline.render(outdoors(), far, light=light)
    whole = len(pipeline._kept._places)
    assert drawn[0] == whole
    assert len(drawn) <= 2
    drawn.clear()
    pipeline.render(outdoors(), scene(BALL, {**BEHIND, "material": {"base_color": [0.9, 0.1, 0.1]}}), light=light)
    assert 0 < sum(drawn) < 0.8 * whole


def test_layers_are_kept_for_a_light_that_stays(pipeline: Pipeline, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not for one that is another every few frames."""
    monkeypatch.setattr("renderer.pipeline.STEADY_FRAMES", 2)
    assert pipeline._kept is not None
    written: list[int] = []
    write = pipeline._kept.write
    monkeypatch.setattr(pipeline._kept, "write", lambda *given: (written.append(frame), write(*given)))
    wanted, light = scene(BALL, MIRROR), None
    for frame in range(12):
        if frame in (0, 2, 4, 6):
            light, _ = pipeline.analyse(outdoors(70.0 + frame))
        pipeline.render(outdoors(), wanted, light=light)
    assert written == [8, 9, 10, 11]


def test_a_frame_under_a_still_light_is_followed(pipeline: Pipeline) -> None:
    """The layers stay; the frame behind them is another in every frame."""
    wanted = scene(BALL)
    light = pipeline.render(outdoors(), wanted).light
    dark = yuv_from_linear(np.full((SIZE[1], SIZE[0], 3), 0.05))
    bright = yuv_from_linear(np.full((SIZE[1], SIZE[0], 3), 0.4))
    found = [next(planes(pipeline.render(frame, wanted, light=light).frame)).astype(int) for frame in (dark, bright)]
    changed = np.abs(found[0] - dark.y) > 2
    assert changed.sum() > 200
    assert ((found[1] - found[0])[changed] > 20).mean() > 0.3      # but not where an object stands

"""Scenes that stand in no textbook, each with its expected answer. Tests run these cases, `mr360 bench` reports them."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from renderer.equirectangular import uv_from_direction
from renderer.frame import RadianceFrame
from renderer.light.detection import Detection, Light
from renderer.light.reading import FrameLight
from renderer.scene import PRESETS, Lighting, Scene
from server.bench.frames import direction, sky_with_sun
from server.bench.hard_cases import Case, expect, nearly
from server.bench.pipelines import Pipelines

Array = NDArray[np.float64]
Objects = list[dict[str, Any]]
SIZE = (256, 128)
METAL = {"base_color": [0.9, 0.9, 0.9], "metallic": 1, "roughness": 0.1}
BALL: dict[str, Any] = {"mesh": "sphere", "position": [0, -1.1, -3]}
BOX: dict[str, Any] = {"mesh": "box", "position": [1.0, -1.1, -3], "material": METAL}
ARRANGEMENTS: dict[str, Objects] = {
    "touching": [BALL, BOX], "one inside another": [BALL, {**BOX, "position": [0, -1.1, -3], "scale": [0.2, 0.2, 0.2]}],
    "the same place": [BALL, {**BALL, "material": METAL}, BOX, {**BOX, "material": None}],
    "half in the ground": [{**BALL, "position": [0, -1.6, -3]}, {**BOX, "position": [1, -1.8, -3]}],
    "flat boxes": [BALL, *({**BOX, "position": [0.7, -1.1, -3 + shift], "scale": flat} for shift, flat in
                           ((0.0, [1e-6, 1, 1]), (0.1, [1, 1e-6, 1]), (0.2, [1, 1, 1e-6])))],
    "mirrored and long": [{**BALL, "scale": [-1, 1, 1], "material": METAL}, {**BOX, "scale": [0.01, 0.01, 10.0]}],
    "small and large": [{**BALL, "scale": [0.001, 0.001, 0.001]}, {**BOX, "position": [0, 0, -60], "scale": [50, 50, 50]}],
}


def scene_cases() -> dict[str, Case]:
    """By name. Each raises MissedError when it is not met."""
    cases: dict[str, Case] = {f"objects {name}": partial(_anywhere, name) for name in ARRANGEMENTS}
    for elevation in (0.0, -0.5, 1.2, 90.0, -90.0, -45.0):
        for radius in (1e-6, 0.0047, 0.15):
            cases[f"a light {elevation:g}° high, of radius {radius:g}"] = partial(_light_at, elevation, radius)
    for preset in PRESETS:
        for roughness in (0.0, 0.2, 0.5, 1.0):
            cases[f"white furnace, roughness {roughness:g}, {preset}"] = partial(_furnace, roughness, preset)
    cases |= {"no lights at all": _no_lights, "eight lights": _eight_lights, "a light under the ground": _under_the_ground,
              "a grazing light": _grazing, "a ball inside a ball": _unseen, "objects without shadows": _no_shadows,
              "the camera inside an object": partial(_refused, [0, 0, 0], [1, 1, 1], "contains the camera"),
              "an object below the floor": partial(_refused, [0, -3, -3], [1, 1, 1], "below the ground")}
    for name in ("touching", "flat boxes"):
        cases[f"a black frame, objects {name}"] = partial(_black, name)
    return cases


def scene_of(objects: Objects, **values: Any) -> Scene:
    return Scene.model_validate({"objects": [{"id": f"o{i}", **item} for i, item in enumerate(objects)], **values})


def lit_by(*lights: Light) -> FrameLight:
    """In a grey that is everywhere."""
    flat = np.full((64, 128, 3), 0.3)     # as many texels as frames of SIZE have
    coefficients = np.zeros((25, 3))
    coefficients[0] = 0.3 * np.sqrt(4 * np.pi)
    return FrameLight(Detection(lights, flat, flat, 0.0), coefficients, flat.astype(np.float32),
                      np.full((64, 128, 3), 0.3 * np.pi, np.float32))


def lamp(azimuth_deg: float, elevation_deg: float, radius: float = 0.01, irradiance: float = 4.0, name: int = 1) -> Light:
    return Light(direction(azimuth_deg, elevation_deg), np.full(3, irradiance), radius, id=name)


def finite_picture(pipelines: Pipelines, frame: RadianceFrame, wanted: Scene, light: FrameLight | None = None) -> Array:
    """(height, width, 3) as it is drawn first, after it has been drawn again by what was kept. Raises MissedError."""
    pipeline = pipelines.of(frame)
    pictures = [pipeline.render(frame, wanted, light=light) for _ in range(2)]
    for rendered in pictures:
        expect(rendered.errors == {}, f"not drawn: {rendered.errors}")
        assert isinstance(rendered.frame, RadianceFrame)
        expect(np.isfinite(rendered.frame.rgb).all(), "the picture is not finite")
        expect((rendered.frame.rgb >= 0).all(), "the picture has negative radiance")
    first = pictures[0].frame
    assert isinstance(first, RadianceFrame)
    return first.rgb.astype(np.float64)


def at(picture: NDArray[np.floating], *points: tuple[float, float, float]) -> Array:
    """(n, 3) what a picture shows where these points are."""
    height, width = picture.shape[:2]
    u, v = (uv_from_direction(np.array(points)) * (width, height)).T.astype(int)
    return np.asarray(picture[v, u], dtype=np.float64)


def _anywhere(name: str, pipelines: Pipelines) -> None:
    frame = sky_with_sun(60, 35, size=SIZE)
    picture = finite_picture(pipelines, frame, scene_of(ARRANGEMENTS[name]))
    expect((picture != frame.rgb).any(), "nothing is drawn")
    brightest = picture[frame.rgb[..., 0] < 100].max()
    expect(brightest < 60, f"radiance {brightest:.0f}, expected no more than what a metal makes of the sun")


def _unseen(pipelines: Pipelines) -> None:
    """What is hidden does not change what hides it by more than what is near it weighs."""
    frame, inner = sky_with_sun(60, 35, size=SIZE), {**BALL, "scale": [0.3, 0.3, 0.3]}
    alone, both = (finite_picture(pipelines, frame, scene_of(items)) for items in ([BALL], [BALL, inner]))
    nearly(at(both, (0.1, -0.9, -2.55)), at(alone, (0.1, -0.9, -2.55)), 0.1, "the outer ball")


def _light_at(elevation: float, radius: float, pipelines: Pipelines) -> None:
    light = lit_by(lamp(30, elevation, radius))
    finite_picture(pipelines, sky_with_sun(60, 35, size=SIZE), scene_of(ARRANGEMENTS["touching"]), light)


def _under_the_ground(pipelines: Pipelines) -> None:
    frame, points = sky_with_sun(60, 35, size=SIZE), ((0.7, -1.6, -3.2), (-0.7, -1.6, -3.2), (0, -1.6, -2.2))
    # without ambient light, so that nothing of what lights the ball from below is given back to the ground
    lights = (replace(light, coefficients=np.zeros((25, 3))) for light in (lit_by(lamp(30, -60)), lit_by()))
    below, none = (finite_picture(pipelines, frame, scene_of([BALL]), light) for light in lights)
    nearly(at(below, *points), at(none, *points), 0.0, "the ground", least=1e-3)


def _grazing(pipelines: Pipelines) -> None:
    """A light one degree above the horizon darkens no more than what it gives the ground, which is next to nothing."""
    frame = sky_with_sun(60, 35, size=SIZE)
    grazing, none = (finite_picture(pipelines, frame, scene_of([BALL]), light) for light in (lit_by(lamp(30, 1.0)), lit_by()))
    ground = np.zeros(SIZE[::-1], dtype=bool)
    ground[SIZE[1] * 3 // 4:] = True
    change = np.abs(grazing - none)[ground].max() / none[ground].max()
    expect(change < 0.08, f"a grazing light changes the ground by {change:.2f}, which is more than it gives")


def _no_lights(pipelines: Pipelines) -> None:
    picture = finite_picture(pipelines, sky_with_sun(60, 35, size=SIZE), scene_of(ARRANGEMENTS["touching"]), lit_by())
    nearly(at(picture, (0, -0.7, -2.7)), np.full((1, 3), 0.3 * 0.8), 0.25, "the ball's upper front")


def _eight_lights(pipelines: Pipelines) -> None:
    lights = tuple(lamp(45 * i, 20, 0.02, 1.0, i) for i in range(8))
    finite_picture(pipelines, sky_with_sun(60, 35, size=SIZE), scene_of(ARRANGEMENTS["touching"]), lit_by(*lights))


def _black(name: str, pipelines: Pipelines) -> None:
    picture = finite_picture(pipelines, RadianceFrame(np.zeros((128, 256, 3), np.float32)), scene_of(ARRANGEMENTS[name]))
    expect(picture.max() == 0.0, f"radiance {picture.max():g} in the dark")


def _no_shadows(pipelines: Pipelines) -> None:
    frame = sky_with_sun(60, 35, size=SIZE)
    picture = finite_picture(pipelines, frame, scene_of([{**item, "casts_shadow": False} for item in ARRANGEMENTS["touching"]]))
    expect((picture != frame.rgb).any(), "nothing is drawn")
    point = (-1.4, -1.6, -3.2)
    expect((at(picture, point) == at(frame.rgb, point)).all(), "the ground is darkened")


def _furnace(roughness: float, preset: str, pipelines: Pipelines) -> None:
    """A white metal ball in a constant light is not to be seen."""
    frame = RadianceFrame(np.full((SIZE[1], SIZE[0], 3), 2.0, np.float32))
    ball = {**BALL, "position": [0, 0, -2], "material": {"base_color": [1, 1, 1], "metallic": 1, "roughness": roughness}}
    scene = scene_of([ball], ground={"catcher": False}).model_copy(update={"lighting": Lighting.model_validate({"preset": preset})})
    nearly(finite_picture(pipelines, frame, scene), np.full((*SIZE[::-1], 3), 2.0), 0.02, "the ball")


def _refused(position: list[float], scale: list[float], why: str, pipelines: Pipelines) -> None:
    """Left out with a reason; the frame stays as it is."""
    frame = sky_with_sun(60, 35, size=SIZE)
    rendered = pipelines.of(frame).render(frame, scene_of([{"mesh": "box", "position": position, "scale": scale}]))
    expect(why in rendered.errors.get("o0", ""), f"errors {rendered.errors}, expected {why!r}")
    assert isinstance(rendered.frame, RadianceFrame)
    expect(np.array_equal(rendered.frame.rgb, frame.rgb), "the frame has changed")

"""Shadows on the ground: a black ball under one light, or under a uniform sky, against the closed form."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from renderer.equirectangular import pixel_directions
from renderer.frame import RadianceFrame, YuvFrame
from renderer.light.detection import Detection, Light
from renderer.light.reading import FrameLight
from renderer.scene import Scene
from server.bench.ball_shadow import hidden_share, hidden_sky
from server.bench.effort import Effort
from server.bench.frames import direction
from server.bench.pipelines import Pipelines
from server.bench.rows import Mark, Row, timed

Array = NDArray[np.float64]
STAGE = "shadows"
MEASURE = ("what is left of the ground's light around a ball's shadow, less the closed form; 1 is the open ground. Time: a "
           "live frame with all that it needs of the ball. `still`: all has settled; `moving`: the light moves by 12° a second")
CAMERA_HEIGHT = 1.6
CENTRE, RADIUS = np.array([0.2, -1.0, -2.4]), 0.35
MARGIN = 1.4        # times the ball, whose shadow with that margin is where it is looked at
WARM_UP, SETTLED = 6, 24
STEP_DEG = 12 / 30  # from frame to frame, as in the demo
METHODS: tuple[tuple[str, Mark], ...] = (("area", "default"), ("pcf", "paper"))


@dataclass(frozen=True)
class Case:
    """What lights the ground: a disc alone (radius in degrees), or a uniform sky (None)."""

    name: str
    radius_deg: float | None
    elevation_deg: float = 45.0


CASES = (Case("sun 0.27°", 0.2665), Case("disc 2°", 2.0), Case("disc 7°, low", 7.0, 28.0), Case("uniform sky", None))


def shadow_rows(pipelines: Pipelines, effort: Effort) -> Iterator[Row]:
    cases = CASES if effort.name == "full" else (CASES[1], CASES[3])
    for case in cases:
        count = -(-effort.repeats // sum((case.radius_deg is None) == (other.radius_deg is None) for other in cases))
        light, kind = _light(case), "disc" if case.radius_deg is not None else "sky"
        pixels, points = _ground(effort.size, light)
        expected = 1.0 - _hidden(points, CENTRE, RADIUS, light)
        for method, mark in METHODS:
            scene = _scene(method)
            for state in ("still", "moving") if light.detection.lights else ("moving",):
                lights = _sequence(light, count + WARM_UP, moving=state == "moving")
                times = _times(pipelines, effort.size, scene, lights)
                errors = _ratio(pipelines, effort.size, scene, lights[-SETTLED:])[pixels] - expected
                yield Row(STAGE, method, case.name, errors, times, state,
                          mark if state == "moving" else "", condition=kind)
        lights = _sequence(light, count + WARM_UP, moving=True)
        times = _times(pipelines, effort.size, _scene("area", catcher=False), lights)
        yield Row(STAGE, "no shadow", case.name, 1.0 - expected, times, condition=kind, mark="null")


def _light(case: Case) -> FrameLight:
    """Given truly: one disc in the dark, or the sky and no disc."""
    sky = 0.0 if case.radius_deg is not None else 1.0
    lights = () if case.radius_deg is None else (
        Light(direction(150, case.elevation_deg), np.ones(3), float(np.radians(case.radius_deg)), id=1),)
    flat, coefficients = np.full((64, 128, 3), sky, np.float32), np.zeros((25, 3))
    coefficients[0] = sky * np.sqrt(4 * np.pi)
    return FrameLight(Detection(lights, flat, flat, 0.0), coefficients, flat, np.pi * flat)


def turned(light: FrameLight, degrees: float) -> FrameLight:
    angle = np.radians(degrees)
    turn = np.array([[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], [np.sin(angle), 0, np.cos(angle)]])
    lights = tuple(replace(one, direction=turn @ one.direction) for one in light.detection.lights)
    return replace(light, detection=replace(light.detection, lights=lights))


def _sequence(light: FrameLight, count: int, *, moving: bool) -> list[FrameLight]:
    """So many lights, each another reading; the last is the light itself, and the sun of the demo has moved there."""
    return [turned(light, -STEP_DEG * (count - 1 - index) if moving else 0.0) for index in range(count)]


def _scene(method: str, *, catcher: bool = True) -> Scene:
    ball = {"id": "ball", "mesh": "sphere", "position": list(CENTRE), "scale": [2 * RADIUS] * 3,
            "material": {"base_color": [0, 0, 0], "roughness": 1.0}}
    return Scene.model_validate({"camera_height": CAMERA_HEIGHT, "objects": [ball], "ground": {"catcher": catcher},
                                 "lighting": {"shadows": method}})


def _times(pipelines: Pipelines, size: tuple[int, int], scene: Scene, lights: list[FrameLight]) -> Array:
    """Of live frames, each under the next light."""
    frame = YuvFrame(np.full(size[::-1], 126, np.uint8), *(np.full((size[1] // 2, size[0] // 2), 128, np.uint8),) * 2)
    pipeline, following = pipelines.of(frame), iter(lights)
    return timed(lambda: pipeline.render(frame, scene, light=next(following)), len(lights) - WARM_UP, WARM_UP)


def _ratio(pipelines: Pipelines, size: tuple[int, int], scene: Scene, lights: list[FrameLight]) -> Array:
    """What the ground of the last of these frames has of its light, (height * width,)."""
    frame = RadianceFrame(np.full((size[1], size[0], 3), 0.5, np.float32))
    pipeline = pipelines.of(frame)
    for light in lights:
        found = pipeline.render(frame, scene, light=light).frame
    assert isinstance(found, RadianceFrame)
    return np.asarray(found.rgb[..., 1].ravel() / 0.5, dtype=np.float64)


def _ground(size: tuple[int, int], light: FrameLight) -> tuple[NDArray[np.intp], Array]:
    """The pixels of the ground in the shadow and around it, not behind the ball: flat indices, and (n, 3) points."""
    directions = pixel_directions(size[1], size[0]).reshape(-1, 3)
    near = np.linalg.norm(np.cross(directions, CENTRE), axis=1) < 1.15 * RADIUS
    below = np.flatnonzero((directions[:, 1] < -0.15) & ~(near & (directions @ CENTRE > 0)))
    points = directions[below] * (-CAMERA_HEIGHT / directions[below, 1])[:, None]
    inside = _hidden(points, CENTRE, MARGIN * RADIUS, light) > 0.01
    return below[inside], points[inside]


def _hidden(points: Array, centre: Array, radius: float, light: FrameLight) -> Array:
    lights = light.detection.lights
    return hidden_share(points, centre, radius, lights[0]) if lights else hidden_sky(points, centre, radius)

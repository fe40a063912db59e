"""The scene of the whole: a diffuse and a glossy ball on the ground, the pixels that are looked at, and what they should be."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from renderer.equirectangular import pixel_directions
from renderer.light.detection import Light
from renderer.light.specular import resample
from renderer.scene import Lighting, Scene
from server.bench.ball_reference import Ball, BallReference, Environment

Array = NDArray[np.float64]
CAMERA_HEIGHT = 1.6
DIFFUSE = Ball("diffuse", np.array([-0.75, -1.2, -2.2]), 0.4, np.array([0.7, 0.6, 0.5]), 0.0, 1.0)
GLOSSY = Ball("glossy", np.array([0.75, -1.2, -2.2]), 0.4, np.array([1.0, 1.0, 1.0]), 1.0, 0.4)
BALLS = (DIFFUSE, GLOSSY)
REGIONS = ("diffuse", "glossy", "ground")
INSIDE = 0.3                # least cosine between normal and viewer: not at the rim, which is the silhouette's matter
GROUND_REACH_M = 1.1        # from the middle of a ball
BACKDROP_ROWS = 128


@dataclass(frozen=True)
class Pixels:
    """By region flat indices of pixels, and (n, 3) what they show: points of a ball or of the ground."""

    indices: dict[str, NDArray[np.intp]]
    points: dict[str, Array]


def balls_scene(lighting: Lighting | None = None, *, ground: bool = True) -> Scene:
    objects = [{"id": ball.name, "mesh": "sphere", "position": list(ball.centre), "scale": [2 * ball.radius] * 3,
                "material": {"base_color": list(ball.color), "metallic": ball.metallic, "roughness": ball.roughness}}
               for ball in BALLS]
    document = {"camera_height": CAMERA_HEIGHT, "objects": objects, "ground": {"catcher": ground}}
    return Scene.model_validate(document).model_copy(update={"lighting": lighting or Lighting()})


@lru_cache(maxsize=4)
def looked_at(size: tuple[int, int], count: int) -> Pixels:
    """About so many pixels of each region, evenly spread."""
    directions = pixel_directions(size[1], size[0]).reshape(-1, 3)
    indices, points = {}, {}
    blocked = np.zeros(len(directions), dtype=bool)
    for ball in BALLS:
        along = directions @ ball.centre
        under_root = along**2 - (ball.centre @ ball.centre - ball.radius**2)
        blocked |= (along > 0) & (under_root > -0.06)
        hit = np.flatnonzero((along > 0) & (under_root > 0))
        at = directions[hit] * (along[hit] - np.sqrt(under_root[hit]))[:, None]
        facing = -(directions[hit] * (at - ball.centre)).sum(axis=1) / ball.radius > INSIDE
        indices[ball.name], points[ball.name] = _some(hit[facing], at[facing], count)
    below = np.flatnonzero((directions[:, 1] < -0.1) & ~blocked)
    at = directions[below] * (-CAMERA_HEIGHT / directions[below, 1])[:, None]
    near = np.min([np.hypot(*(at - ball.centre)[:, [0, 2]].T) for ball in BALLS], axis=0) < GROUND_REACH_M
    indices["ground"], points["ground"] = _some(below[near], at[near], count)
    return Pixels(indices, points)


def _some(indices: NDArray[np.intp], points: Array, count: int) -> tuple[NDArray[np.intp], Array]:
    chosen = np.random.default_rng(4).permutation(len(indices))[:count]
    return indices[chosen], points[chosen]


def environment(sky: NDArray[np.floating], lights: tuple[Light, ...], backdrop: NDArray[np.floating]) -> Environment:
    return Environment(np.asarray(sky, dtype=np.float64), lights,
                       np.asarray(resample(backdrop, BACKDROP_ROWS, 2 * BACKDROP_ROWS), dtype=np.float64)
                       if backdrop.shape[0] > BACKDROP_ROWS else np.asarray(backdrop, dtype=np.float64))


def true_radiance(given: Environment, pixels: Pixels, background: Array, texels: int) -> dict[str, Array]:
    """(n, 3) radiance by region. `background`: (height * width, 3), the frame's."""
    reference = BallReference(given, BALLS, CAMERA_HEIGHT, texels)
    found = {}
    for ball in BALLS:
        points = pixels.points[ball.name]
        views = -points / np.linalg.norm(points, axis=1, keepdims=True)
        found[ball.name] = reference.radiance(ball, points, views)
    found["ground"] = background[pixels.indices["ground"]] * reference.ground(pixels.points["ground"])
    return found

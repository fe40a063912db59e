"""Which tiles of the frame a real surface's shadows may lie in."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from renderer.gpu_mesh import PlacedMesh
from renderer.light_detection import Light
from renderer.near_field import Body
from renderer.placement import TileMask, tile_grid, touched_tiles

Array = NDArray[np.float64]
SEGMENTS = 8               # of a shadow's way; each is bounded on its own
AMBIENT_REACH = 4.0        # in radii of an object, from its middle: it takes a sixteenth of the view from there
SLACK = np.radians(2.0)    # that a light may move while the tiles are kept
_GRID = np.array([(i, j, 6 - i - j) for i in range(7) for j in range(7 - i)]) / 6.0
_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float64)


def surface_points(placed: PlacedMesh) -> Array:
    """(n, 3) points all over a surface in the world."""
    points, triangles = placed.mesh.mesh.proxy
    matrix = placed.world_from_model
    corners = (points @ matrix[:3, :3].T + matrix[:3, 3])[triangles]
    return np.asarray(np.einsum("gc,tcx->tgx", _GRID, corners).reshape(-1, 3))


def surface_tiles(body: Body, points: Array, frame_size: tuple[int, int]) -> TileMask:
    """The tiles that show a surface, given by points all over it; all of them when it is around the camera."""
    return _everywhere(frame_size) if surrounds_camera(body) else touched_tiles(points, frame_size)


def surrounds_camera(body: Body) -> bool:
    """Whether a thing is all around the camera, as a room is."""
    return bool((np.abs(body.solid.unit_from_world[:3, 3]) < 0.5).all())


def ambient_tiles(caster: Body, frame_size: tuple[int, int]) -> TileMask:
    """The tiles where surfaces may be that an object takes visibly from."""
    return _box_tiles(caster.solid.centre, AMBIENT_REACH * caster.solid.radius, frame_size)


def light_tiles(caster: Body, light: Light, points: Array, frame_size: tuple[int, int]) -> TileMask:
    """The tiles that an object's shadow passes through on its way to surfaces that lie at `points`."""
    centre, radius = caster.solid.centre, caster.solid.radius
    farthest = float(((centre - points) @ light.direction).max()) + radius
    mask = np.zeros(tile_grid(frame_size)[::-1], dtype=bool)
    if farthest <= 0:
        return mask
    spread = float(np.tan(light.angular_radius + SLACK))
    steps = np.concatenate([[0.0], np.geomspace(min(radius, farthest), max(farthest, 1e-3), SEGMENTS)])
    for near, far in pairwise(steps):
        around = [centre - light.direction * at + _CORNERS * (radius + spread * at) for at in np.linspace(near, far, 4)]
        box = np.concatenate(around)
        if _is_around_camera(box):
            return _everywhere(frame_size)
        mask |= touched_tiles(box, frame_size)
    return mask


def _box_tiles(centre: NDArray[np.floating], half: float, frame_size: tuple[int, int]) -> TileMask:
    box = centre + _CORNERS * half
    if _is_around_camera(box):
        return _everywhere(frame_size)
    edges = [a + (b - a) * t for a in box for b in box for t in (0.0, 0.25, 0.5)]
    return touched_tiles(np.array(edges), frame_size)


def _is_around_camera(box: Array) -> bool:
    return bool((box.min(axis=0) < 0).all() and (box.max(axis=0) > 0).all())


def _everywhere(frame_size: tuple[int, int]) -> TileMask:
    return np.ones(tile_grid(frame_size)[::-1], dtype=bool)

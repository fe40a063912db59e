"""Which tiles of the frame a real surface's shadows may lie in: each tile's place on the surfaces, and what reaches it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from renderer.equirectangular import direction_from_uv
from renderer.light.detection import Light
from renderer.models.gpu_mesh import PlacedMesh
from renderer.objects.near_field import Body
from renderer.objects.placement import TILE, TileMask, tile_grid, touched_tiles

Array = NDArray[np.float64]
AMBIENT_REACH = 4.0        # in radii of an object, from its middle: it takes a sixteenth of the view from there
SLACK = np.radians(2.0)    # that a light may move while the views are kept
_GRID = np.array([(i, j, 6 - i - j) for i in range(7) for j in range(7 - i)]) / 6.0
_RAYS_AT_ONCE = 4096


@dataclass(frozen=True)
class SurfaceTiles:
    """Where in the world the tiles of the frame that show some surfaces are: (rows, columns, 3) places, those of the nearest, NaN
    where there are none; and (rows, columns) how far from them the rest of a tile may be, in metres."""

    places: Array
    sizes: Array

    @property
    def shown(self) -> TileMask:
        return np.asarray(np.isfinite(self.places[..., 0]))

    def reached(self, caster: Body, lights: tuple[Light, ...], slack: float) -> TileMask:
        """The tiles where an object may take something: of the light around, or of lights, which may move by `slack` radians."""
        centre, radius = caster.solid.centre, caster.solid.radius
        with np.errstate(invalid="ignore"):
            towards = centre - self.places
            mask = np.linalg.norm(towards, axis=-1) < AMBIENT_REACH * radius + self.sizes
            for light in lights:
                along = towards @ light.direction
                aside = np.linalg.norm(towards - along[..., None] * light.direction, axis=-1)
                widened = radius + self.sizes + np.maximum(along, 0.0) * np.tan(light.angular_radius + slack)
                mask |= (along > -radius - self.sizes) & (aside < widened)
        return np.asarray(mask)


def surface_tiles(things: list[tuple[PlacedMesh, Body]], frame_size: tuple[int, int]) -> SurfaceTiles:
    """Of the nearest of some things, by their proxies."""
    columns, rows = tile_grid(frame_size)
    uv = np.stack(np.meshgrid(np.arange(2 * columns + 1) * TILE / 2 / frame_size[0],
                              np.minimum(np.arange(2 * rows + 1) * TILE / 2 / frame_size[1], 1.0)), axis=-1)
    directions = direction_from_uv(uv)
    distance = np.full(directions.shape[:2], np.inf)
    for placed, body in things:
        corners = _triangles(placed)
        points = np.einsum("gc,tcx->tgx", _GRID, corners).reshape(-1, 3)
        shown = np.ones((rows, columns), dtype=bool) if surrounds_camera(body) else touched_tiles(points, frame_size)
        wanted = np.zeros_like(distance, dtype=bool)
        for i in range(3):
            for j in range(3):
                wanted[i:i + 2 * rows:2, j:j + 2 * columns:2][:rows, :columns] |= shown
        distance[wanted] = np.minimum(distance[wanted], _hits(directions[wanted], corners))
    around = np.stack([distance[i:i + 2 * rows:2, j:j + 2 * columns:2] for i in range(3) for j in range(3)])
    seen = np.stack([directions[i:i + 2 * rows:2, j:j + 2 * columns:2] for i in range(3) for j in range(3)])
    found = np.isfinite(around)
    nearest = np.where(found, around, np.inf).argmin(axis=0)[None]
    with np.errstate(invalid="ignore"):
        points = seen * np.where(found, around, np.nan)[..., None]
        places = np.take_along_axis(points, nearest[..., None], axis=0)[0]
        sizes = np.nan_to_num(np.linalg.norm(points - places, axis=-1)).max(axis=0)
    return SurfaceTiles(places, sizes)


def surrounds_camera(body: Body) -> bool:
    """Whether a thing is all around the camera, as a room is."""
    return bool((np.abs(body.solid.unit_from_world[:3, 3]) < 0.5).all())


def _triangles(placed: PlacedMesh) -> Array:
    """(n, 3, 3) corners in the world."""
    points, triangles = placed.mesh.mesh.proxy
    matrix = placed.world_from_model
    return np.asarray((points @ matrix[:3, :3].T + matrix[:3, 3])[triangles], dtype=np.float64)


def _hits(directions: Array, corners: Array) -> Array:
    """(n,) distance at which rays from the camera along (n, 3) directions first meet a triangle, inf for none."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    height = (normal * corners[:, 0]).sum(axis=1)
    # a ray meets it where it is on the same side of the planes through the camera and each edge
    sides = [np.cross(corners[:, i], corners[:, (i + 1) % 3]) for i in range(3)]
    found = []
    for rays in np.array_split(directions, max(1, len(directions) // _RAYS_AT_ONCE)):
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = height / (rays @ normal.T)
            signs = [rays @ side.T for side in sides]
        least, most = np.minimum.reduce(signs), np.maximum.reduce(signs)
        inside = ((least >= -1e-9) | (most <= 1e-9)) & (distance > 0)
        found.append(np.where(inside, distance, np.inf).min(axis=1, initial=np.inf))
    return np.concatenate(found)

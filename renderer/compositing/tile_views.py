"""Views that show given tiles of the frame, each tile in one of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label

from renderer.equirectangular import direction_from_uv
from renderer.objects.placement import NEAR_M, TILE, TileMask, View, single_view, tile_grid

Array = NDArray[np.float64]
MAX_VIEWS = 12


def cube_face_of_tiles(frame_size: tuple[int, int]) -> NDArray[np.intp]:
    """(rows, columns) the cube face, 2 * axis + negative, that the middle of each tile lies in."""
    columns, rows = tile_grid(frame_size)
    middle = _directions(np.arange(columns) + 0.5, np.arange(rows) + 0.5, frame_size)
    axis = np.abs(middle).argmax(axis=-1)
    return np.asarray(2 * axis + (np.take_along_axis(middle, axis[..., None], axis=-1)[..., 0] < 0))


def views_of_tiles(tiles: TileMask, frame_size: tuple[int, int], farthest: float, members: tuple[int, ...]) -> tuple[View, ...]:
    """Views as wide as their tiles, for things as far as `farthest` metres."""
    faces = cube_face_of_tiles(frame_size)
    rows, columns = tiles.shape
    edges = _directions(np.linspace(0, columns, 2 * columns + 1), np.linspace(0, rows, 2 * rows + 1), frame_size)
    views = []
    for mask in _patches(tiles, faces):
        row, column = np.nonzero(mask)
        points = np.concatenate([edges[2 * row + i, 2 * column + j] for i in range(3) for j in range(3)])
        axis = points.mean(axis=0)
        views.append(single_view(points, axis / np.linalg.norm(axis), frame_size, (NEAR_M, 2 * farthest + 1), members, mask))
    return tuple(views)


def _patches(tiles: TileMask, faces: NDArray[np.intp]) -> list[TileMask]:
    """The tiles of each face, in connected patches if these are not too many: a view is a rectangle, however little of it is
    wanted."""
    of_faces = [tiles & (faces == face) for face in np.unique(faces[tiles])]
    patches = []
    for mask in of_faces:
        labels, count = label(mask, structure=np.ones((3, 3)))
        patches += [np.asarray(labels == index) for index in range(1, count + 1)]
    return patches if len(patches) <= MAX_VIEWS else of_faces


def _directions(columns: NDArray[np.floating], rows: NDArray[np.floating], frame_size: tuple[int, int]) -> Array:
    """(rows, columns, 3) of places counted in tiles."""
    uv = np.stack(np.meshgrid(columns * TILE / frame_size[0], np.minimum(rows * TILE / frame_size[1], 1.0)), axis=-1)
    return np.asarray(direction_from_uv(uv))

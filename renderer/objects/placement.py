"""Where objects lie in the panorama: pixel tiles that they touch, and the perspective views that are drawn for them.

The frame is cut into square tiles. Objects that share a tile are drawn into one view, so that depth decides between them; a
group that is wider than a view can be is drawn into the faces of a cube.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from renderer.equirectangular import uv_from_direction

Array = NDArray[np.float64]
TileMask = NDArray[np.bool_]
TILE = 16                          # pixels; even, so that chroma blocks are whole
MARGIN_PIXELS = 2
MAX_VIEW_HALF_ANGLE = np.radians(50.0)
NEAR_M = 0.02
MAX_DENSITY = 2.0                  # view pixels per panorama pixel, at the centre of a view: at least 1, and more for a small one,
VIEW_PIXELS = 10_000               # which is edges for the most part, up to this many in all
MAX_VIEW_SIZE = 2048


def tile_grid(frame_size: tuple[int, int]) -> tuple[int, int]:
    """Columns and rows of tiles that cover the frame."""
    return -(-frame_size[0] // TILE), -(-frame_size[1] // TILE)


def touched_tiles(points: Array, frame_size: tuple[int, int]) -> TileMask:
    """(rows, columns) of the tiles that the convex region spanned by (n, 3) points, seen from the origin, may touch.

    The points must sample the region's outline finely enough; it may cross the seam and cover a pole, and must not contain
    the origin.
    """
    width, height = frame_size
    columns, rows = tile_grid(frame_size)
    mask = np.zeros((rows, columns), dtype=bool)
    directions = points / np.maximum(np.linalg.norm(points, axis=1, keepdims=True), 1e-12)
    axis = directions.mean(axis=0)
    axis /= max(float(np.linalg.norm(axis)), 1e-12)
    half_angle = float(np.arccos(np.clip(directions @ axis, -1, 1)).max())
    uv = uv_from_direction(directions)
    top, bottom = uv[:, 1].min() * height - MARGIN_PIXELS, uv[:, 1].max() * height + MARGIN_PIXELS
    polar = float(np.arccos(np.clip(axis[1], -1, 1)))
    whole_width = polar <= half_angle or np.pi - polar <= half_angle
    if polar <= half_angle:
        top = 0.0
    if np.pi - polar <= half_angle:
        bottom = float(height)
    first_row, last_row = max(0, int(top // TILE)), min(rows - 1, int(bottom // TILE))
    if whole_width:
        mask[first_row:last_row + 1] = True
        return mask
    centre = float(uv_from_direction(axis)[0])
    offset = (uv[:, 0] - centre + 0.5) % 1.0 - 0.5  # unwrapped around the region's own longitude
    left = (centre + offset.min()) * width - MARGIN_PIXELS
    right = (centre + offset.max()) * width + MARGIN_PIXELS
    if right - left >= width:
        mask[first_row:last_row + 1] = True
        return mask
    for shift in (-width, 0, width):
        first, last = max(left + shift, 0.0), min(right + shift, width - 1.0)
        if first <= last:
            mask[first_row:last_row + 1, int(first // TILE):int(last // TILE) + 1] = True
    return mask


@dataclass(frozen=True)
class View:
    """A perspective view from the origin. Rows of `rotation` are right, up, forward; `bounds` are left, right, bottom, top on
    the tangent plane; `cube_axis` is the face 2 * axis + negative, or -1 when the view is no cube face;
    `density`, view pixels per panorama pixel; `member_tiles` those of each member alone. With `mirror_y` it shows the world
    mirrored at this height, in metres."""

    rotation: Array
    bounds: tuple[float, float, float, float]
    size: tuple[int, int]
    depth_range: tuple[float, float]
    members: tuple[int, ...]
    tiles: TileMask
    cube_axis: int = -1
    density: float = 1.0
    mirror_y: float | None = None
    member_tiles: tuple[TileMask, ...] = ()

    @property
    def camera_y(self) -> float:
        """Height of the camera, or of its mirror image, in metres."""
        return 0.0 if self.mirror_y is None else 2 * self.mirror_y

    @property
    def axes(self) -> Array:
        """(3, 3) what of the world lies along right, up and forward; those of the mirrored camera where there is one."""
        return self.rotation if self.mirror_y is None else self.rotation * (1.0, -1.0, 1.0)

    def clip_from_world(self) -> Array:
        """(4, 4) OpenGL projection times rotation."""
        left, right, bottom, top = self.bounds
        near, far = self.depth_range
        projection = np.array([
            [2 / (right - left), 0, -(left + right) / (right - left), 0],
            [0, 2 / (top - bottom), -(bottom + top) / (top - bottom), 0],
            [0, 0, (far + near) / (far - near), -2 * far * near / (far - near)],
            [0, 0, 1, 0],
        ])
        world = np.eye(4)
        world[:3, :3] = self.axes
        world[:3, 3] = -self.axes[:, 1] * self.camera_y
        return np.asarray(projection @ world)


def plan_views(outlines: list[Array], tiles: list[TileMask], frame_size: tuple[int, int],
               max_half_angle: float = MAX_VIEW_HALF_ANGLE) -> list[View]:
    """Views for objects given by their (n, 3) world outlines and touched tiles, grouped where tiles are shared."""
    views: list[View] = []
    for group in _groups(tiles):
        points = np.concatenate([outlines[i] for i in group])
        mask = np.logical_or.reduce([tiles[i] for i in group])
        axis = _mean_direction(points)
        directions = points / np.linalg.norm(points, axis=1, keepdims=True)
        distance = np.linalg.norm(points, axis=1)
        depth_range = (max(NEAR_M, 0.3 * float(distance.min())), 2.0 * float(distance.max()) + 1.0)
        if float((directions @ axis).min()) >= np.cos(max_half_angle):
            found = [single_view(points, axis, frame_size, depth_range, tuple(group), mask)]
        else:
            found = [_cube_face(face, frame_size, depth_range, tuple(group), mask) for face in range(6)]
        views += [replace(view, member_tiles=tuple(tiles[i] for i in group)) for view in found]
    return views


def _groups(tiles: list[TileMask]) -> list[list[int]]:
    groups: list[tuple[list[int], TileMask]] = []
    for index, mask in enumerate(tiles):
        members, merged = [index], mask
        separate = []
        for other, other_mask in groups:
            if (other_mask & merged).any():
                members, merged = other + members, merged | other_mask
            else:
                separate.append((other, other_mask))
        groups = [*separate, (members, merged)]
    return [members for members, _ in groups]


def _mean_direction(points: Array) -> Array:
    mean = (points / np.linalg.norm(points, axis=1, keepdims=True)).mean(axis=0)
    return np.asarray(mean / max(float(np.linalg.norm(mean)), 1e-12))


def looking_along(forward: NDArray[np.floating]) -> Array:
    """(3, 3) rows right, up, forward."""
    helper = np.array([0.0, 1.0, 0.0]) if abs(forward[1]) < 0.9 else np.array([0.0, 0.0, 1.0])
    right = np.cross(forward, helper)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(right, forward), forward])


def _size(bounds: tuple[float, float, float, float], frame_size: tuple[int, int]) -> tuple[tuple[int, int], float]:
    """The size of a view, and its pixels per panorama pixel."""
    left, right, bottom, top = bounds
    panorama = frame_size[0] / (2 * np.pi)
    pixels = (right - left) * (top - bottom) * panorama**2
    density = float(np.clip(np.sqrt(VIEW_PIXELS / max(pixels, 1e-9)), 1.0, MAX_DENSITY))
    width, height = (int(np.clip(np.ceil(extent * panorama * density), 8, MAX_VIEW_SIZE))
                     for extent in (right - left, top - bottom))
    return (width, height), density


def single_view(points: Array, axis: Array, frame_size: tuple[int, int], depth_range: tuple[float, float],
                members: tuple[int, ...], mask: TileMask) -> View:
    """A view along `axis` that shows (n, 3) points."""
    rotation = looking_along(axis)
    local = points @ rotation.T
    tangent = local[:, :2] / local[:, 2:3]
    margin = MARGIN_PIXELS * 2 * np.pi / frame_size[0]
    left, bottom = tangent.min(axis=0) - margin
    right, top = tangent.max(axis=0) + margin
    bounds = (float(left), float(right), float(bottom), float(top))
    size, density = _size(bounds, frame_size)
    return View(rotation, bounds, size, depth_range, members, mask, density=density)


def _cube_face(face: int, frame_size: tuple[int, int], depth_range: tuple[float, float], members: tuple[int, ...],
               mask: TileMask) -> View:
    forward = np.zeros(3)
    forward[face // 2] = -1.0 if face % 2 else 1.0
    bounds = (-1.01, 1.01, -1.01, 1.01)
    size, density = _size(bounds, frame_size)
    return View(looking_along(forward), bounds, size, depth_range, members, mask, face, density)

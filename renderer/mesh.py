"""Triangle meshes as arrays, the built-in ones, and what is derived once at load: shadow proxy and outline.

Metres, +Y up. `sphere` has diameter 1, `box` edge 1, `cylinder` diameter 1 and height 1 along Y, each centred on its
origin; `teapot` stands on y = 0 and is 1 high.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import fast_simplification
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

Points = NDArray[np.float32]
Triangles = NDArray[np.int32]
MAX_PROXY_TRIANGLES = 128
MAX_FINE_TRIANGLES = 500
_OUTLINE_STEPS = 4


@dataclass(frozen=True)
class Surface:
    """glTF metallic-roughness of one primitive. Textures are (height, width, 4) uint8 or None."""

    base_color: tuple[float, float, float, float] = (0.8, 0.8, 0.8, 1.0)
    metallic: float = 0.0
    roughness: float = 0.5
    emissive: tuple[float, float, float] = (0.0, 0.0, 0.0)
    base_color_texture: NDArray[np.uint8] | None = None
    metallic_roughness_texture: NDArray[np.uint8] | None = None
    emissive_texture: NDArray[np.uint8] | None = None
    double_sided: bool = False
    alpha_cutoff: float | None = None


@dataclass(frozen=True)
class Primitive:
    """(n, 3) positions and unit normals, (n, 2) texture coordinates, (m, 3) triangles, one surface."""

    positions: Points
    normals: Points
    uvs: Points
    triangles: Triangles
    surface: Surface = field(default_factory=Surface)


@dataclass(frozen=True)
class Mesh:
    """What an object looks like, in its own coordinates."""

    primitives: tuple[Primitive, ...]

    @property
    def triangle_count(self) -> int:
        return sum(len(p.triangles) for p in self.primitives)

    @cached_property
    def proxy(self) -> tuple[Points, Triangles]:
        """(n, 3) points and (m <= 128, 3) triangles that cast the shadow in place of the mesh."""
        return _simplified(self, MAX_PROXY_TRIANGLES)

    @cached_property
    def fine_proxy(self) -> tuple[Points, Triangles]:
        """The same with up to 500 triangles, for shadows whose edge is sharp enough to show them."""
        return _simplified(self, MAX_FINE_TRIANGLES)

    @cached_property
    def outline(self) -> Points:
        """(n, 3) points whose projections bound the mesh's projection: the hull's corners and points on its edges."""
        points = self.proxy[0] if self.triangle_count > 50_000 else np.concatenate([p.positions for p in self.primitives])
        try:
            hull = ConvexHull(points.astype(np.float64))
        except (QhullError, ValueError):  # flat or degenerate
            low, high = points.min(axis=0), points.max(axis=0)
            corners = np.array([[(low, high)[i >> a & 1][a] for a in range(3)] for i in range(8)])
            return corners.astype(np.float32)
        corners = points[hull.vertices]
        edges = np.unique(np.sort(np.concatenate([hull.simplices[:, [0, 1]], hull.simplices[:, [1, 2]],
                                                  hull.simplices[:, [2, 0]]]), axis=1), axis=0)
        start, end = points[edges[:, 0]], points[edges[:, 1]]
        size = float(np.linalg.norm(np.ptp(points, axis=0)))
        long_edge = np.linalg.norm(end - start, axis=1) > 0.1 * size
        steps = np.linspace(0, 1, _OUTLINE_STEPS + 1)[1:-1, None, None]
        between = (start[long_edge] * (1 - steps) + end[long_edge] * steps).reshape(-1, 3)
        return np.concatenate([corners, between]).astype(np.float32)


def welded(mesh: Mesh) -> tuple[Points, Triangles]:
    """All primitives as one surface whose equal positions are one vertex, without degenerate triangles."""
    offsets = np.cumsum([0] + [len(p.positions) for p in mesh.primitives[:-1]])
    points = np.concatenate([p.positions for p in mesh.primitives])
    triangles = np.concatenate([p.triangles + o for p, o in zip(mesh.primitives, offsets, strict=True)])
    unique, inverse = np.unique(points, axis=0, return_inverse=True)
    triangles = inverse.reshape(-1)[triangles]
    a, b, c = triangles.T
    return unique, triangles[(a != b) & (b != c) & (c != a)].astype(np.int32)


def _simplified(mesh: Mesh, most: int) -> tuple[Points, Triangles]:
    points, triangles = welded(mesh)
    if len(triangles) > most:
        points, triangles = fast_simplification.simplify(points, triangles, target_count=most)
    if len(triangles) > most:  # many loose parts, which edge collapse cannot join
        points, triangles = _clustered(points, triangles, most)
    return np.asarray(points, dtype=np.float32), np.asarray(triangles, dtype=np.int32)


def _clustered(points: Points, triangles: Triangles, most: int) -> tuple[Points, Triangles]:
    """Vertices snapped to the finest grid that leaves few enough triangles."""
    low, size = points.min(axis=0), max(float(np.ptp(points, axis=0).max()), 1e-12)
    for cells in (24, 20, 16, 12, 10, 8, 6, 5, 4, 3, 2):
        keys = np.round((points - low) / size * cells).astype(np.int64)
        unique, inverse = np.unique(keys, axis=0, return_inverse=True)
        merged = np.sort(inverse.reshape(-1)[triangles], axis=1)
        a, b, c = merged.T
        merged = np.unique(merged[(a != b) & (b != c) & (c != a)], axis=0)
        if len(merged) <= most:
            break
    return (unique / cells * size + low).astype(np.float32), merged[:most].astype(np.int32)


def _grid(rows: int, columns: int) -> Triangles:
    """Two triangles per cell of a (rows + 1) x (columns + 1) vertex grid, counter-clockwise seen from outside."""
    r, c = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    a = (r * (columns + 1) + c).ravel()
    b, d, e = a + 1, a + columns + 1, a + columns + 2
    return np.concatenate([np.stack([a, d, b], axis=1), np.stack([b, d, e], axis=1)]).astype(np.int32)


def _ring(columns: int) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    fraction = np.arange(columns + 1) / columns
    angle = fraction * 2 * np.pi
    return fraction, np.sin(angle), np.cos(angle)


def sphere(rows: int = 32, columns: int = 64) -> Mesh:
    u, s, c = _ring(columns)
    polar = (np.arange(rows + 1) / rows * np.pi)[:, None]
    normals = np.stack(np.broadcast_arrays(np.sin(polar) * s, np.cos(polar), np.sin(polar) * c), axis=-1).reshape(-1, 3)
    uvs = np.stack(np.broadcast_arrays(u, polar / np.pi), axis=-1).reshape(-1, 2)
    triangles = _grid(rows, columns)
    area = np.linalg.norm(np.cross(*(normals[triangles[:, i]] - normals[triangles[:, 0]] for i in (1, 2))), axis=1)
    return Mesh((Primitive(_f4(normals * 0.5), _f4(normals), _f4(uvs), triangles[area > 1e-9]),))


def box() -> Mesh:
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * 0.5
    positions: list[NDArray[np.float64]] = []
    normals, uvs, triangles = [], [], []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            face = np.zeros((4, 3))
            face[:, (axis + 1) % 3], face[:, (axis + 2) % 3] = corners.T
            face[:, axis] = 0.5 * sign
            normal = np.zeros(3)
            normal[axis] = sign
            first = 4 * len(positions)
            order = [[0, 1, 2], [0, 2, 3]] if sign > 0 else [[0, 2, 1], [0, 3, 2]]
            triangles.append(np.array(order) + first)
            positions.append(face)
            normals.append(np.tile(normal, (4, 1)))
            uvs.append(corners + 0.5)
    return Mesh((Primitive(_f4(np.concatenate(positions)), _f4(np.concatenate(normals)), _f4(np.concatenate(uvs)),
                           np.concatenate(triangles).astype(np.int32)),))


def cylinder(columns: int = 64) -> Mesh:
    u, s, c = _ring(columns)
    side = np.concatenate([np.stack([s * 0.5, np.full_like(s, y), c * 0.5], axis=1) for y in (0.5, -0.5)])
    side_normals = np.tile(np.stack([s, np.zeros_like(s), c], axis=1), (2, 1))
    side_uvs = np.concatenate([np.stack([u, np.full_like(u, v)], axis=1) for v in (0.0, 1.0)])
    parts = [(side, side_normals, side_uvs, _grid(1, columns))]
    for y in (0.5, -0.5):
        rim = np.stack([s * 0.5, np.full_like(s, y), c * 0.5], axis=1)
        points = np.concatenate([[[0.0, y, 0.0]], rim])
        fan = np.stack([np.zeros(columns), np.arange(1, columns + 1), np.arange(2, columns + 2)], axis=1).astype(np.int32)
        parts.append((points, np.tile([0.0, np.sign(y), 0.0], (len(points), 1)), points[:, [0, 2]] + 0.5,
                      fan if y > 0 else fan[:, ::-1]))
    offsets = np.cumsum([0] + [len(p[0]) for p in parts[:-1]])
    points, normals, uvs = (_f4(np.concatenate([p[i] for p in parts])) for i in range(3))
    return Mesh((Primitive(points, normals, uvs,
                           np.concatenate([p[3] + o for p, o in zip(parts, offsets, strict=True)]).astype(np.int32)),))


def _f4(values: NDArray[np.floating]) -> Points:
    return np.ascontiguousarray(values, dtype=np.float32)


BUILT_IN: dict[str, Callable[[], Mesh]] = {"sphere": sphere, "box": box, "cylinder": cylinder}

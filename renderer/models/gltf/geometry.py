"""One primitive of a file as arrays, in the coordinates of its mesh."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from renderer.models.mesh import TextureMapping
from renderer.models.proxy import Points, Triangles
from renderer.models.skeleton import Array32, flat_normals

_NO_AREA = 1e-10        # twice a triangle's area by its longest edge squared


@dataclass(frozen=True)
class Targets:
    """Morph targets: (t, n, 3) displacements."""

    positions: Array32
    normals: Array32 | None
    tangents: Array32 | None


@dataclass(frozen=True)
class Geometry:
    """One primitive of the file. `joints` (n, k) index the skin's joints, with (n, k) weights whose sum is 1; `flat` says that
    no vertex is shared and normals are those of the triangles."""

    positions: Points
    normals: Points
    triangles: Triangles
    flat: bool
    uvs: Points
    uvs2: Points | None
    colors: Points | None
    tangents: Points | None
    joints: NDArray[np.int64] | None
    weights: Array32 | None
    targets: Targets | None


def has_corners(triangles: Triangles) -> NDArray[np.bool_]:
    a, b, c = triangles.T
    return np.asarray((a != b) & (b != c) & (c != a))


def has_area(positions: Points, triangles: Triangles) -> NDArray[np.bool_]:
    corners = positions[triangles].astype(np.float64)
    edges = corners - corners[:, [1, 2, 0]]
    longest = np.einsum("ijk,ijk->ij", edges, edges).max(axis=1)
    a, b = edges[:, 0], edges[:, 1]
    area = np.sqrt((a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1])**2 + (a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2])**2
                   + (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])**2)
    return np.asarray(area > _NO_AREA * longest)


def compact(geometry: Geometry) -> Geometry:
    """Without the vertices that no triangle has, if there are any."""
    used = np.zeros(len(geometry.positions), dtype=bool)
    used[geometry.triangles] = True
    if used.all():
        return geometry
    return replace(_taken(geometry, np.flatnonzero(used)), triangles=(np.cumsum(used) - 1)[geometry.triangles].astype(np.int32))


def unshared(geometry: Geometry) -> Geometry:
    """With three vertices for each triangle, which have its normal."""
    result = _taken(geometry, geometry.triangles.ravel())
    triangles = np.arange(geometry.triangles.size, dtype=np.int32).reshape(-1, 3)
    return replace(result, triangles=triangles, normals=np.repeat(flat_normals(result.positions.reshape(-1, 3, 3)), 3, axis=0))


def _taken(geometry: Geometry, vertices: NDArray[Any]) -> Geometry:
    def taken(array: NDArray[Any] | None) -> Any:
        return None if array is None else array[..., vertices, :]

    g, t = geometry, geometry.targets
    return Geometry(taken(g.positions), taken(g.normals), g.triangles, g.flat, taken(g.uvs), taken(g.uvs2), taken(g.colors),
                    taken(g.tangents), taken(g.joints), taken(g.weights),
                    t and Targets(taken(t.positions), taken(t.normals), taken(t.tangents)))


def with_tangents(geometry: Geometry, mapping: TextureMapping) -> Geometry:
    """With tangents along increasing u of a mapping: of each vertex the mean of its triangles', orthogonal to its normal."""
    uvs = geometry.uvs2 if mapping.uv_set == 1 and geometry.uvs2 is not None else geometry.uvs
    uv = mapped(uvs, mapping)[geometry.triangles].astype(np.float64)
    corners = geometry.positions[geometry.triangles].astype(np.float64)
    (e1, e2), (d1, d2) = ((a[:, 1] - a[:, 0], a[:, 2] - a[:, 0]) for a in (corners, uv))
    sign = np.sign(d1[:, :1] * d2[:, 1:] - d2[:, :1] * d1[:, 1:])
    along_u, along_v = (d2[:, 1:] * e1 - d1[:, 1:] * e2) * sign, (d1[:, :1] * e2 - d2[:, :1] * e1) * sign
    sums = []
    for along in (along_u, along_v):
        length = np.linalg.norm(along, axis=1, keepdims=True)
        unit = np.where(length > 0, along / np.where(length > 0, length, 1.0), 0.0)
        sums.append(np.stack([np.bincount(geometry.triangles.ravel(), np.repeat(unit[:, axis], 3), len(geometry.positions))
                              for axis in range(3)], axis=1))
    normals = geometry.normals.astype(np.float64)
    tangents = sums[0] - normals * np.einsum("ij,ij->i", normals, sums[0])[:, None]
    length = np.linalg.norm(tangents, axis=1, keepdims=True)
    tangents = np.where(length > 1e-6, tangents / np.maximum(length, 1e-6), _any_orthogonal(normals))
    handedness = np.where(np.einsum("ij,ij->i", np.cross(normals, tangents), sums[1]) > 0, -1.0, 1.0)
    return replace(geometry, tangents=np.concatenate([tangents, handedness[:, None]], axis=1).astype(np.float32))


def _any_orthogonal(normals: NDArray[np.float64]) -> NDArray[np.float64]:
    axis = np.where(np.abs(normals[:, :1]) < 0.9, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    result = np.cross(normals, axis)
    return np.asarray(result / np.maximum(np.linalg.norm(result, axis=1, keepdims=True), 1e-12))


def mapped(uvs: Points, mapping: TextureMapping) -> Points:
    """(n, 2) coordinates at which the mapping's texture is read."""
    matrix = np.array(mapping.matrix)
    return np.asarray(uvs @ matrix[:, :2].T + matrix[:, 2], dtype=np.float32)

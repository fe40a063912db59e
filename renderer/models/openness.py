"""How open each vertex of a mesh is to the light around it: the cosine-weighted share of its hemisphere that the mesh itself leaves
free, in front and, where a surface has two sides, behind. Measured once when a mesh is loaded, at rest, by depth maps from
directions all around it; what is convex needs none."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from renderer.gl import Context, release_all
from renderer.models.gpu_mesh import GpuMesh, PlacedMesh
from renderer.models.shapes import fitted_shape
from renderer.objects.placement import looking_along
from renderer.objects.surfaces import SurfaceStage

Array = NDArray[np.floating]
SIZE = 256                     # texels a side of a depth map
DIRECTIONS = (8, 64)           # fewest and most
TRIANGLES = 600_000            # to be drawn in all: half of the time that a mesh may take
OFFSET = 0.01                  # of the mesh's size: how far off its surface a vertex looks from
SLOPE = 1.5                    # texels that a surface may rise within its own


@dataclass(frozen=True)
class _DepthMap:
    """(SIZE, SIZE) depth of a mesh along a direction; `clip_from_centred` (3, 3) turns points about its centre into the map's."""

    depth: Array
    clip_from_centred: Array

    def sees(self, start: Array) -> Array:
        """(n,) whether nothing of the mesh is in this direction of (n, 3) points about its centre."""
        at = (start @ self.clip_from_centred.T) * 0.5 + 0.5
        texel = np.clip((at[:, :2] * SIZE).astype(np.intp), 0, SIZE - 1)
        return np.asarray(self.depth[texel[:, 1], texel[:, 0]] > at[:, 2] - SLOPE / SIZE)


class OpennessStage:
    """Owns the depth map."""

    def __init__(self, context: Context, surfaces: SurfaceStage) -> None:
        self._surfaces = surfaces
        self._depth = context.gl.depth_texture((SIZE, SIZE))
        self._framebuffer = context.gl.framebuffer([], self._depth)
        self._rest = context.rest

    def bake(self, mesh: GpuMesh) -> None:
        """Give the mesh's vertices their openness."""
        if fitted_shape(mesh.mesh).is_convex:
            return
        parts = mesh.mesh.primitives
        points, normals = (np.concatenate([getattr(part, name) for part in parts]).astype(np.float64)
                           for name in ("positions", "normals"))
        low, high = points.min(axis=0), points.max(axis=0)
        centre, radius = (low + high) / 2, max(float(np.linalg.norm(high - low)) / 2, 1e-9)
        count = int(np.clip(TRIANGLES / max(mesh.mesh.triangle_count, 1), *DIRECTIONS))
        sides = (1.0, -1.0) if any(part.surface.double_sided for part in parts) else (1.0,)
        self._surfaces.set_ground(None)     # at rest it stands nowhere; whoever draws it next says where the ground is
        free, whole = np.zeros((len(points), 2)), np.zeros((len(points), 2))
        for direction in _sphere_directions(count):
            depth = self._depth_map(mesh, centre, radius, direction)
            for index, side in enumerate(sides):
                weight = np.maximum(side * (normals @ direction), 0.0)
                whole[:, index] += weight
                free[:, index] += weight * depth.sees(points + normals * (side * 2 * radius * OFFSET) - centre)
        opened = np.where(whole > 0, free / np.maximum(whole, 1e-9), 1.0).astype(np.float32)
        for part, values in zip(mesh.parts, np.split(opened, np.cumsum([len(p.positions) for p in parts])[:-1]), strict=True):
            part.set_openness(values)

    def _depth_map(self, mesh: GpuMesh, centre: Array, radius: float, direction: Array) -> _DepthMap:
        rotation = looking_along(-direction)
        clip = np.eye(4)
        clip[:3, :3] = rotation / (1.05 * radius)
        clip[:3, 3] = -clip[:3, :3] @ centre
        self._framebuffer.use()
        self._framebuffer.viewport = (0, 0, SIZE, SIZE)
        self._framebuffer.clear(depth=1.0)
        self._surfaces.draw_depth(clip, [PlacedMesh(mesh, np.eye(4), None)])
        return _DepthMap(np.frombuffer(self._depth.read(), dtype="f4").reshape(SIZE, SIZE), clip[:3, :3])

    def release(self) -> None:
        self._rest()
        release_all(self._framebuffer, self._depth)


def _sphere_directions(count: int) -> Array:
    """(count, 3) spread evenly (Fibonacci)."""
    index = np.arange(count)
    y, phi = 1 - 2 * (index + 0.5) / count, index * np.pi * (3 - np.sqrt(5))
    s = np.sqrt(1 - y * y)
    return np.stack([s * np.cos(phi), y, s * np.sin(phi)], axis=1)

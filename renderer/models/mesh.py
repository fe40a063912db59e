"""Triangle meshes as arrays, what is derived once from them, and the built-in ones.

Metres, +Y up. `sphere` has diameter 1, `box` edge 1, `cylinder` diameter 1 and height 1 along Y, each centred on its
origin; `teapot` stands on y = 0 and is 1 high.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from renderer.models.proxy import Points, Triangles, outline, simplified, thinned, welded
from renderer.models.skeleton import Pose, Posed, Rig

Texture = NDArray[np.uint8]
Wrap = Literal["repeat", "mirror", "clamp"]
Slot = Literal["base_color", "metallic_roughness", "normal", "occlusion", "emissive"]
MAX_PROXY_TRIANGLES = 128
MAX_FINE_TRIANGLES = 500


@dataclass(frozen=True)
class TextureMapping:
    """Where a texture is read: `matrix` (2 x 3) times (u, v, 1) of `Primitive.uvs` (set 0) or `Primitive.uvs2` (set 1)."""

    uv_set: int = 0
    matrix: tuple[tuple[float, float, float], tuple[float, float, float]] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    wrap: tuple[Wrap, Wrap] = ("repeat", "repeat")
    nearest: bool = False


@dataclass(frozen=True)
class Surface:
    """glTF metallic-roughness of one primitive. Textures are (height, width, 4) uint8 or None.

    Base colour and emission are sRGB in textures and linear in factors; occlusion is R, roughness G, metallic B. A slot that
    is not in `mappings` has the default one. `alpha_cutoff` is None unless `alpha_mode` is 'mask'.
    """

    base_color: tuple[float, float, float, float] = (0.8, 0.8, 0.8, 1.0)
    metallic: float = 0.0
    roughness: float = 0.5
    emissive: tuple[float, float, float] = (0.0, 0.0, 0.0)
    base_color_texture: Texture | None = None
    metallic_roughness_texture: Texture | None = None
    emissive_texture: Texture | None = None
    double_sided: bool = False
    alpha_cutoff: float | None = None
    normal_texture: Texture | None = None
    normal_scale: float = 1.0
    occlusion_texture: Texture | None = None
    occlusion_strength: float = 1.0
    alpha_mode: Literal["opaque", "mask", "blend"] = "opaque"
    unlit: bool = False
    clearcoat: float = 0.0
    clearcoat_roughness: float = 0.0
    mappings: dict[Slot, TextureMapping] = field(default_factory=dict)


@dataclass(frozen=True)
class Primitive:
    """(n, 3) positions and unit normals, (n, 2) texture coordinates, (m, 3) triangles, one surface.

    `tangents` (n, 4), w the sign of the bitangent, where the surface has a normal map; `colors` (n, 4) linear factors of the
    base colour, if any; `uvs2` (n, 2) where a mapping reads set 1.
    """

    positions: Points
    normals: Points
    uvs: Points
    triangles: Triangles
    surface: Surface = field(default_factory=Surface)
    tangents: Points | None = None
    colors: Points | None = None
    uvs2: Points | None = None


@dataclass(frozen=True)
class Mesh:
    """What an object looks like, in its own coordinates, and how it moves; its arrays are those at rest."""

    primitives: tuple[Primitive, ...]
    rig: Rig | None = None

    @property
    def triangle_count(self) -> int:
        return sum(len(p.triangles) for p in self.primitives)

    @property
    def is_animated(self) -> bool:
        """Whether a clip moves any part of it."""
        return self.rig is not None

    @property
    def clips(self) -> tuple[str, ...]:
        return tuple(clip.name for clip in self.rig.clips) if self.rig else ()

    def clip_seconds(self, name: str) -> float:
        """The length of a clip. Raises ValueError, which lists the clips, for a name that is none of them."""
        return self._rig(name).clip(name).seconds

    def pose(self, clip: str | None, seconds: float = 0.0, loop: bool = True) -> Pose:
        """The mesh at one moment of a clip; at rest with None. A clip that does not loop stays at its first and last moment.

        Raises ValueError, which lists the clips, for a name that is none of them, and for a time that is not finite.
        """
        if clip is None:
            return self._rest
        rig = self._rig(clip)
        moved = rig.posed(rig.clip(clip), seconds, loop)
        return Pose(tuple(moved.get(index, rest) for index, rest in enumerate(self._rest.primitives)))

    def _rig(self, clip: str) -> Rig:
        if self.rig is None:
            raise ValueError(f"clip {clip!r} does not exist, the model has none")
        return self.rig

    @cached_property
    def _rest(self) -> Pose:
        return Pose(tuple(Posed(p.positions, p.normals, p.tangents) for p in self.primitives))

    @cached_property
    def fine_proxy(self) -> tuple[Points, Triangles]:
        """(n, 3) points and (m <= 500, 3) triangles in place of the mesh: for collisions, and for shadows whose edge is sharp
        enough to show them."""
        return simplified(*welded([(p.positions, p.triangles) for p in self.primitives]), MAX_FINE_TRIANGLES)

    @cached_property
    def proxy(self) -> tuple[Points, Triangles]:
        """The same with up to 128 triangles, for all other shadows."""
        return simplified(*welded([self.fine_proxy]), MAX_PROXY_TRIANGLES)

    @cached_property
    def outline(self) -> Points:
        """(n, 3) points whose projections bound the mesh's projection."""
        return outline(self.proxy[0] if self.triangle_count > 50_000 else np.concatenate([p.positions for p in self.primitives]))

    def posed_proxy(self, pose: Pose, fine: bool = False) -> Points:
        """(n, 3) points of `proxy`, or of `fine_proxy`, in a pose: each moves as the vertex next to it at rest."""
        points = (self.fine_proxy if fine else self.proxy)[0]
        return points + self._displacements(pose)[self._next_vertices[fine]]

    def posed_outline(self, pose: Pose) -> Points:
        """(n, 3) points whose projections bound the mesh's projection in a pose; of many vertices, that of some."""
        return outline(thinned(np.concatenate([part.positions for part in pose.primitives])))

    def _displacements(self, pose: Pose) -> Points:
        return np.concatenate([np.zeros_like(rest.positions) if part is rest else part.positions - rest.positions
                               for part, rest in zip(pose.primitives, self._rest.primitives, strict=True)])

    @cached_property
    def _next_vertices(self) -> dict[bool, NDArray[np.intp]]:
        tree = cKDTree(np.concatenate([p.positions for p in self.primitives]))
        return {fine: np.asarray(tree.query(proxy[0])[1]) for fine, proxy in ((True, self.fine_proxy), (False, self.proxy))}


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

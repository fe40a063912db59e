"""Objects as one simple solid each, for what they do to the light around them: what they hide, reflect and are seen as in mirrors.

Boxes, ellipsoids and cylinders in their own unit space (edge or diameter 1, centred); the built-in meshes are exactly theirs.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from renderer.models.mesh import Mesh
from renderer.models.proxy import volume

Array = NDArray[np.floating]
Kind = Literal["box", "ellipsoid", "cylinder"]
KINDS: tuple[Kind, ...] = ("box", "ellipsoid", "cylinder")
_VOLUMES = {"box": 1.0, "ellipsoid": np.pi / 6, "cylinder": np.pi / 4}
_MIN_EXTENT = 1e-4


@dataclass(frozen=True)
class Shape:
    """A solid of one kind; `model_from_unit` (4, 4) places it in the mesh's coordinates."""

    kind: Kind
    model_from_unit: Array
    is_convex: bool = False     # whether the mesh is, so that it cannot hide a light from itself


def fitted_shape(mesh: Mesh) -> Shape:
    """The kind whose volume in the mesh's bounding box is nearest to that of its hull, scaled to that volume."""
    points = mesh.outline.astype(np.float64)
    low, high = points.min(axis=0), points.max(axis=0)
    extent = np.maximum(high - low, _MIN_EXTENT)
    is_convex = False
    try:
        hull = float(ConvexHull(points).volume)
        share = hull / float(np.prod(extent))
        is_convex = _is_closed(mesh) and abs(sum(volume(p.positions, p.triangles) for p in mesh.primitives) - hull) < 0.01 * hull
    except (QhullError, ValueError):    # flat
        share = 1.0
    kind = min(KINDS, key=lambda name: abs(_VOLUMES[name] - share))
    scale = min(1.0, (share / _VOLUMES[kind]) ** (1 / 3)) if share < 0.97 * _VOLUMES[kind] else 1.0
    matrix = np.eye(4)
    matrix[:3, :3] = np.diag(extent * scale)
    matrix[:3, 3] = (low + high) / 2
    return Shape(kind, matrix, is_convex)


def _is_closed(mesh: Mesh) -> bool:
    """Whether nothing seems to be cut out of the surface: its area vectors then sum to 0. A bowl has the hull of its outside, and
    hides light from its inside all the same."""
    corners = np.concatenate([p.positions[p.triangles] for p in mesh.primitives]).astype(np.float64)
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return bool(np.linalg.norm(areas.sum(axis=0)) < 0.01 * np.linalg.norm(areas, axis=1).sum())


def hit(kind: Kind, origins: Array, directions: Array) -> tuple[Array, Array]:
    """Where rays in unit space, (n, 3) each, enter the solid: (n,) parameter along the direction, inf for none, 0 from inside; and
    (n, 3) normals there, not normalised."""
    with np.errstate(divide="ignore", invalid="ignore"):
        intervals = _intervals(kind, origins, directions)
        enters = np.stack([enter for enter, _ in intervals])
        last, part = enters.max(axis=0), enters.argmax(axis=0)
        distance = _entry(last, np.min([leave for _, leave in intervals], axis=0))
    at = origins + directions * np.where(np.isfinite(distance), distance, 0.0)[:, None]
    if kind == "ellipsoid":
        return distance, at
    if kind == "cylinder":
        part = np.where(part == 0, 1, -1)       # the caps, or -1 for the side
        at[:, 1] = 0.0
    normals = np.zeros_like(origins)
    rows = np.arange(len(origins))
    normals[rows, part] = -np.sign(directions[rows, part])
    return distance, np.where((part < 0)[:, None], at, normals)


def hides(kind: Kind, origins: Array, directions: Array) -> NDArray[np.bool_]:
    """(n,) whether rays in unit space meet the solid."""
    with np.errstate(divide="ignore", invalid="ignore"):
        intervals = _intervals(kind, origins, directions)
        enter, leave = intervals[0]
        for other_enter, other_leave in intervals[1:]:
            enter, leave = np.maximum(enter, other_enter), np.minimum(leave, other_leave)
        return np.asarray((enter < leave) & (leave > 0))


def _intervals(kind: Kind, origins: Array, directions: Array) -> list[tuple[Array, Array]]:
    """Where rays enter and leave each of the kind's convex parts: slabs along x, y, z; or caps, then side; or the sphere."""
    axes = {"box": (0, 1, 2), "cylinder": (1,), "ellipsoid": ()}[kind]
    found = [_interval(origins[:, axis], directions[:, axis]) for axis in axes]
    return found if kind == "box" else [*found, _round(origins, directions, (0, 2) if kind == "cylinder" else (0, 1, 2))]


def _entry(enter: Array, leave: Array) -> Array:
    return np.where((enter < leave) & (leave > 0), np.maximum(enter, 0.0), np.inf)


def _interval(origin: Array, direction: Array) -> tuple[Array, Array]:
    one, other = (-0.5 - origin) / direction, (0.5 - origin) / direction
    outside = (direction == 0) & (np.abs(origin) > 0.5)
    enter, leave = np.minimum(one, other), np.maximum(one, other)
    enter, leave = np.where(np.isnan(enter), -np.inf, enter), np.where(np.isnan(leave), np.inf, leave)
    return np.where(outside, np.inf, enter), np.where(outside, -np.inf, leave)


def _round(origins: Array, directions: Array, axes: tuple[int, ...]) -> tuple[Array, Array]:
    """Enter and leave of the circle or sphere of diameter 1 over some axes."""
    a = sum(directions[:, axis] * directions[:, axis] for axis in axes) + 1e-30
    b = sum(origins[:, axis] * directions[:, axis] for axis in axes)
    c = sum(origins[:, axis] * origins[:, axis] for axis in axes) - 0.25
    root = np.sqrt(b * b - a * c)       # NaN: passes by
    missed = np.isnan(root)
    return np.where(missed, np.inf, (-b - root) / a), np.where(missed, -np.inf, (-b + root) / a)


@dataclass(frozen=True)
class Solid:
    """A shape in the world."""

    kind: Kind
    world_from_unit: Array
    unit_from_world: Array

    @staticmethod
    def placed(shape: Shape, world_from_model: Array) -> Solid:
        matrix = np.asarray(world_from_model @ shape.model_from_unit)
        return Solid(shape.kind, matrix, np.asarray(np.linalg.inv(matrix), dtype=np.float64))

    @cached_property
    def centre(self) -> Array:
        return np.asarray(self.world_from_unit[:3, 3])

    @cached_property
    def radius(self) -> float:
        """Of a sphere around it."""
        corner = {"box": np.sqrt(3.0), "ellipsoid": 1.0, "cylinder": np.sqrt(2.0)}[self.kind]
        return float(0.5 * corner * np.linalg.norm(self.world_from_unit[:3, :3], axis=0).max())

    @property
    def mean_radius(self) -> float:
        """Of a sphere of its volume."""
        space = _VOLUMES[self.kind] * abs(float(np.linalg.det(self.world_from_unit[:3, :3])))
        return float((3 / (4 * np.pi) * space) ** (1 / 3))

    def hides(self, points: Array, directions: Array) -> NDArray[np.bool_]:
        """(points, directions): whether it is in the way from each point in each direction."""
        linear, offset = self.unit_from_world[:3, :3], self.unit_from_world[:3, 3]
        origins = np.repeat((points @ linear.T + offset).astype(np.float32), len(directions), axis=0)
        rays = np.tile((directions @ linear.T).astype(np.float32), (len(points), 1))
        return hides(self.kind, origins, rays).reshape(len(points), len(directions))

    def hit(self, origins: Array, directions: Array) -> tuple[Array, Array]:
        """(n,) distance in lengths of `directions`, inf for none; (n, 3) unit normals in the world."""
        linear, offset = self.unit_from_world[:3, :3], self.unit_from_world[:3, 3]
        distance, normals = hit(self.kind, origins @ linear.T + offset, directions @ linear.T)
        world = normals @ linear
        return distance, world / np.maximum(np.linalg.norm(world, axis=1, keepdims=True), 1e-12)

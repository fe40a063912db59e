"""Reads the primitives of a file's meshes: what strangers put in attributes, indices, weights and targets."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from renderer.models.gltf.accessors import Buffers
from renderer.models.gltf.document import GltfError, extension, shown
from renderer.models.gltf.geometry import Geometry, Targets, compact, has_area, has_corners, unshared, with_tangents
from renderer.models.mesh import Surface, TextureMapping
from renderer.models.proxy import Points, Triangles
from renderer.models.skeleton import MAX_COORDINATE, Array32

MAX_TRIANGLES = 500_000
MAX_VERTICES = 3 * MAX_TRIANGLES
MAX_TARGETS = 512
MAX_MORPHED_VERTICES = 4_000_000    # times their targets
TRIANGLES, STRIP, FAN = 4, 5, 6
_UV_LIMIT = 1e6


class Primitives:
    """Reads primitives; one that many nodes show is read once."""

    def __init__(self, buffers: Buffers) -> None:
        self._buffers = buffers
        self._known: dict[str, Geometry | None] = {}
        self._morphed = 0

    def triangles_and_vertices(self, primitive: Any, part: str) -> tuple[int, int]:
        """How many the primitive claims to have, before any is read."""
        vertices = self._buffers.count(primitive.attributes.POSITION, f"{part} POSITION")
        corners = vertices if primitive.indices is None else self._buffers.count(primitive.indices, f"{part} indices")
        triangles = corners // 3 if mode_of(primitive) == TRIANGLES else max(corners - 2, 0)
        return triangles, max(vertices, 3 * triangles) if primitive.attributes.NORMAL is None else vertices

    def get(self, primitive: Any, surface: Surface, part: str) -> Geometry | None:
        """The primitive's arrays, or None if it has no triangle with an area."""
        if part not in self._known:
            self._known[part] = self._read(primitive, surface, part)
        return self._known[part]

    def _read(self, primitive: Any, surface: Surface, part: str) -> Geometry | None:
        attributes = primitive.attributes
        positions = self._finite(attributes.POSITION, 3, f"{part} POSITION")
        targets = self._targets(primitive, len(positions), part)
        triangles = self._triangles(primitive, len(positions), part)
        triangles = triangles[has_area(positions, triangles) if targets is None else has_corners(triangles)]
        if not len(triangles):
            return None
        flat = attributes.NORMAL is None
        normals = (np.zeros_like(positions) if flat else self._directions(
            attributes.NORMAL, 3, len(positions), f"{part} NORMAL", [0.0, 1.0, 0.0]).astype(np.float32))
        joints, weights = self._influences(attributes, len(positions), part)
        geometry = Geometry(
            positions, normals, triangles, flat, *self._texture_coordinates(attributes, surface, len(positions), part),
            self._colors(attributes, len(positions), part), self._tangents(attributes, surface, len(positions), part),
            joints, weights, targets)
        geometry = unshared(geometry) if flat else compact(geometry)
        if surface.normal_texture is not None and geometry.tangents is None:
            geometry = with_tangents(geometry, surface.mappings.get("normal", TextureMapping()))
        return geometry

    def _vectors(self, index: Any, width: int, part: str, count: int | None) -> NDArray[Any]:
        values = self._buffers.accessor(index, part, (f"VEC{width}",))
        if count is not None and len(values) != count:
            raise GltfError(f"{part} has {len(values)} elements, expected as many as there are positions, {count}")
        return values

    def _finite(self, index: Any, width: int, part: str, count: int | None = None) -> Array32:
        values = self._vectors(index, width, part, count).astype(np.float32)
        largest = np.abs(values).max()
        if not largest <= MAX_COORDINATE:
            raise GltfError(f"{part} has values that are not finite" if not np.isfinite(values).all() else
                            f"{part} has {largest:g}, expected at most {MAX_COORDINATE:g} in magnitude")
        return values

    def _directions(self, index: Any, width: int, count: int, part: str, instead: list[float]) -> NDArray[np.float64]:
        """Vectors whose first three numbers have length 1; those without a direction become `instead`."""
        values = np.clip(np.nan_to_num(self._vectors(index, width, part, count).astype(np.float64)), -1e9, 1e9)
        length = np.linalg.norm(values[:, :3], axis=1, keepdims=True)
        values[:, :3] = np.where(length > 1e-12, values[:, :3] / np.maximum(length, 1e-12), instead)
        return values

    def _tangents(self, attributes: Any, surface: Surface, count: int, part: str) -> Array32 | None:
        if surface.normal_texture is None or attributes.TANGENT is None or attributes.NORMAL is None:
            return None     # glTF: without normals, given tangents do not count
        values = self._directions(attributes.TANGENT, 4, count, f"{part} TANGENT", [1.0, 0.0, 0.0])
        values[:, 3] = np.where(values[:, 3] < 0, -1.0, 1.0)
        return values.astype(np.float32)

    def _texture_coordinates(self, attributes: Any, surface: Surface, count: int, part: str) -> tuple[Points, Points | None]:
        second = any(mapping.uv_set == 1 for mapping in surface.mappings.values())
        sets = []
        for name, wanted in (("TEXCOORD_0", True), ("TEXCOORD_1", second)):
            index = getattr(attributes, name)
            values = (np.zeros((count, 2)) if index is None or not wanted
                      else np.nan_to_num(self._vectors(index, 2, f"{part} {name}", count).astype(np.float64)))
            sets.append(np.clip(values, -_UV_LIMIT, _UV_LIMIT).astype(np.float32))
        return sets[0], sets[1] if second else None

    def _colors(self, attributes: Any, count: int, part: str) -> Points | None:
        if attributes.COLOR_0 is None:
            return None
        values = self._buffers.accessor(attributes.COLOR_0, f"{part} COLOR_0", ("VEC3", "VEC4"))
        if len(values) != count or values.dtype.kind != "f":
            raise GltfError(f"{part} COLOR_0 has {len(values)} elements of {values.dtype}, expected {count}, normalised or float")
        colors = np.ones((count, 4), dtype=np.float32)
        colors[:, :values.shape[1]] = np.clip(np.nan_to_num(values), 0, 1)
        return colors

    def _triangles(self, primitive: Any, count: int, part: str) -> Triangles:
        corners = np.arange(count)
        if primitive.indices is not None:
            values = self._buffers.accessor(primitive.indices, f"{part} indices", ("SCALAR",))
            if values.dtype.kind != "u":
                raise GltfError(f"{part} indices are {values.dtype}, expected unsigned whole numbers")
            corners = values.ravel().astype(np.int64)
            if corners.max() >= count:
                raise GltfError(f"{part}: index {corners.max()}, expected less than its {count} vertices")
        mode = mode_of(primitive)
        if mode == TRIANGLES:
            if len(corners) % 3:
                raise GltfError(f"{part}: {len(corners)} corners, expected a multiple of 3")
            return corners.reshape(-1, 3).astype(np.int32)
        first = np.arange(max(len(corners) - 2, 0))
        order = (np.stack([first, first + 1 + first % 2, first + 2 - first % 2], axis=1) if mode == STRIP
                 else np.stack([first + 1, first + 2, np.zeros_like(first)], axis=1))
        return corners[order].astype(np.int32)

    def _influences(self, attributes: Any, count: int, part: str) -> tuple[NDArray[np.int64] | None, Array32 | None]:
        joints, weights = [], []
        for number in range(2):
            of_joints, of_weights = (getattr(attributes, f"{name}_{number}", None) for name in ("JOINTS", "WEIGHTS"))
            if of_joints is None and of_weights is None:
                break
            values = self._buffers.accessor(of_joints, f"{part} JOINTS_{number}", ("VEC4",))
            if values.dtype.kind != "u" or len(values) != count:
                raise GltfError(f"{part} JOINTS_{number} has {len(values)} elements of {values.dtype}, expected {count} of "
                                f"unsigned whole numbers")
            joints.append(values.astype(np.int64))
            weights.append(self._finite(of_weights, 4, f"{part} WEIGHTS_{number}", count))
        if not joints:
            return None, None
        weight = np.maximum(np.concatenate(weights, axis=1), 0)
        total = weight.sum(axis=1, keepdims=True)
        if not total.min() > 0:
            raise GltfError(f"{part}: the weights of vertex {int(total.argmin())} sum to {total.min():g}, expected 1")
        return np.concatenate(joints, axis=1), weight / total

    def _targets(self, primitive: Any, count: int, part: str) -> Targets | None:
        targets = primitive.targets or []
        if not targets:
            return None
        self._morphed += len(targets) * max(count, self.triangles_and_vertices(primitive, part)[1])
        if self._morphed > MAX_MORPHED_VERTICES:
            raise GltfError(f"{part}: {len(targets)} morph targets of {count} vertices, with them {self._morphed} vertices are "
                            f"morphed, expected at most {MAX_MORPHED_VERTICES}")
        stacks: dict[str, Array32 | None] = {}
        for name in ("POSITION", "NORMAL", "TANGENT"):
            indices = [_attribute(target, name, part) for target in targets]
            stacks[name] = None if all(index is None for index in indices) else np.stack([
                np.zeros((count, 3), np.float32) if index is None
                else self._finite(index, 3, f"{part} target {number} {name}", count)
                for number, index in enumerate(indices)])
        positions = stacks["POSITION"]
        return Targets(np.zeros((len(targets), count, 3), np.float32) if positions is None else positions,
                       stacks["NORMAL"], stacks["TANGENT"])


def mode_of(primitive: Any) -> int:
    return TRIANGLES if primitive.mode is None else int(primitive.mode)


def checked(primitive: Any, part: str) -> Any:
    """The primitive, if its geometry is in accessors and can be read."""
    if extension(primitive, "KHR_draco_mesh_compression", part) is not None:
        raise GltfError(f"{part}: KHR_draco_mesh_compression is not supported")
    if getattr(primitive.attributes, "POSITION", None) is None:
        raise GltfError(f"{part}: has no POSITION")
    if primitive.mode is not None and (type(primitive.mode) is not int or not 0 <= primitive.mode <= FAN):
        raise GltfError(f"{part}: mode is {shown(primitive.mode)}, expected 0 to {FAN}")
    if len(primitive.targets or []) > MAX_TARGETS:
        raise GltfError(f"{part}: has {len(primitive.targets)} morph targets, expected at most {MAX_TARGETS}")
    return primitive


def _attribute(target: Any, name: str, part: str) -> Any:
    if not isinstance(target, dict):
        target = getattr(target, "__dict__", None)
    if target is None:
        raise GltfError(f"{part}: a morph target is no object of attributes")
    return target.get(name)

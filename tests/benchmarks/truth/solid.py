"""A scene's objects as the path tracer takes them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from renderer.color import linear_from_srgb
from renderer.pipeline import Placement
from tests.benchmarks.truth.path_tracer import Solid

Array = NDArray[np.float64]


def solid_of(placement: Placement) -> tuple[Solid, list[str], list[Array]]:
    """All placed objects in one mesh; their names; (2, 3) bounds of each."""
    columns: dict[str, list[Any]] = {name: [] for name in ("positions", "normals", "uvs", "triangles", "material", "materials")}
    names, bounds, owners, textures = [], [], [], []
    vertices = 0
    for name, placed in placement.objects.items():
        matrix = placed.world_from_model
        cofactor = np.linalg.inv(matrix[:3, :3])
        corners = []
        for index, primitive in enumerate(placed.mesh.mesh.primitives):
            positions, found = primitive.positions, primitive.normals
            if placed.pose is not None:
                positions, found, _ = placed.pose.primitives[index]
            surface = placed.surface or primitive.surface
            points = positions @ matrix[:3, :3].T + matrix[:3, 3]
            normals = found @ cofactor
            columns["positions"].append(points)
            columns["normals"].append(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12))
            columns["uvs"].append(primitive.uvs)
            columns["triangles"].append(primitive.triangles + vertices)
            columns["material"].append(np.full(len(primitive.triangles), len(owners)))
            columns["materials"].append((*surface.base_color[:3], surface.metallic, surface.roughness, *surface.emissive))
            textures.append(None if placed.surface else surface.base_color_texture)
            owners.append(len(names))
            vertices += len(points)
            corners.append(points)
        names.append(name)
        everything = np.concatenate(corners)
        bounds.append(np.stack([everything.min(axis=0), everything.max(axis=0)]))
    texture = next((t for t in textures if t is not None), None)
    joined = {name: np.concatenate(values) for name, values in columns.items() if name != "materials"}
    solid = Solid(
        joined["positions"].astype("f4"), joined["normals"].astype("f4"), joined["uvs"].astype("f4"),
        joined["triangles"].astype("i4"), joined["material"].astype("i4"), np.array(columns["materials"], dtype=np.float64),
        np.array(owners, dtype=np.int32),
        None if texture is None else linear_from_srgb(texture[..., :3] / 255.0).astype("f4"),
        tuple(t is not None for t in textures))
    return solid, names, bounds

"""Joins the parts of one material to a primitive and what moves it."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from renderer.models.gltf.geometry import Geometry, mapped
from renderer.models.mesh import Primitive, Surface, TextureMapping
from renderer.models.proxy import Points, Triangles
from renderer.models.skeleton import Deformer, Morph, Posed


@dataclass(frozen=True)
class Part:
    """A primitive of the file as one node shows it; `joints` (n, k) index the palette of matrices, with (n, k) weights."""

    geometry: Geometry
    node: int
    joints: NDArray[np.int64]
    weights: NDArray[np.float32]
    mirrored: bool

    @property
    def triangles(self) -> Triangles:
        return self.geometry.triangles[:, ::-1] if self.mirrored else self.geometry.triangles


def deformer(parts: list[Part], palette_size: int) -> Deformer:
    """What moves the parts, as one."""
    starts = _starts(parts)
    tangents = _joined(parts, lambda g: g.tangents, 0.0, 4)
    if tangents is not None:
        mirrored = np.repeat([part.mirrored for part in parts], [len(part.geometry.positions) for part in parts])
        tangents[:, 3] *= np.where(mirrored, -1, 1)
    base = Posed(np.concatenate([part.geometry.positions for part in parts]),
                 np.concatenate([part.geometry.normals for part in parts]), tangents)
    morphs = tuple(Morph(start, part.node, targets.positions, None if part.geometry.flat else targets.normals,
                         None if tangents is None else targets.tangents)
                   for part, start in zip(parts, starts, strict=True) if (targets := part.geometry.targets) is not None)
    flat = [part.triangles + start for part, start in zip(parts, starts, strict=True) if part.geometry.flat]
    counts = np.concatenate([np.full(len(part.joints), part.joints.shape[1]) for part in parts])
    influence = csr_array((np.concatenate([part.weights.ravel() for part in parts]),
                           np.concatenate([part.joints.ravel() for part in parts]), np.concatenate([[0], np.cumsum(counts)])),
                          shape=(len(counts), palette_size))
    influence.eliminate_zeros()
    return Deformer(base, influence, morphs, np.concatenate(flat) if flat else np.zeros((0, 3), np.int32))


def primitive(parts: list[Part], surface: Surface, posed: Posed) -> Primitive:
    """The parts as one primitive whose vertices are posed."""
    triangles = np.concatenate([part.triangles + start for part, start in zip(parts, _starts(parts), strict=True)])
    uvs, uvs2 = _joined(parts, lambda g: g.uvs, 0.0, 2), _joined(parts, lambda g: g.uvs2, 0.0, 2)
    assert uvs is not None
    shared = _shared_mapping(surface)
    if shared is not None:
        uvs, uvs2 = mapped(uvs2 if shared.uv_set == 1 and uvs2 is not None else uvs, shared), None
        unmoved = TextureMapping()
        surface = replace(surface, mappings={
            slot: baked for slot, mapping in surface.mappings.items()
            if (baked := replace(mapping, uv_set=0, matrix=unmoved.matrix)) != unmoved})
    return Primitive(posed.positions, posed.normals, uvs, triangles.astype(np.int32), surface, posed.tangents,
                     _joined(parts, lambda g: g.colors, 1.0, 4), uvs2)


def _shared_mapping(surface: Surface) -> TextureMapping | None:
    """The place in the texture coordinates that all textures have in common, which vertices can hold as well."""
    textures = {"base_color": surface.base_color_texture, "metallic_roughness": surface.metallic_roughness_texture,
                "normal": surface.normal_texture, "occlusion": surface.occlusion_texture, "emissive": surface.emissive_texture}
    used = [mapping for slot, mapping in surface.mappings.items() if textures[slot] is not None]
    alike = len({(mapping.uv_set, mapping.matrix) for mapping in used}) == 1
    return used[0] if alike and len(used) == sum(texture is not None for texture in textures.values()) else None


def _starts(parts: list[Part]) -> list[int]:
    return list(itertools.accumulate((len(part.geometry.positions) for part in parts[:-1]), initial=0))


def _joined(parts: list[Part], of: Callable[[Geometry], Points | None], missing: float, width: int) -> Points | None:
    """One array of all parts, filled up where a part has none; None if none has."""
    arrays: list[NDArray[Any] | None] = [of(part.geometry) for part in parts]
    if all(array is None for array in arrays):
        return None
    return np.concatenate([np.full((len(part.geometry.positions), width), missing, np.float32) if array is None else array
                           for part, array in zip(parts, arrays, strict=True)])

"""Moves the vertices of an animated model: morph targets, then skins or rigid nodes, in numpy.

A vertex on a rigid node is one on a skin with a single joint, so that parts of one material stay one primitive.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from renderer.models.animation import Clip
from renderer.models.hierarchy import Array, Hierarchy, Indices, matrices

Array32 = NDArray[np.float32]
MAX_COORDINATE = 1e9        # metres; beyond this a float32 has no use


class Posed(NamedTuple):
    """(n, 3) positions and unit normals, (n, 4) tangents where the primitive has a normal map; float32, in model space."""

    positions: Array32
    normals: Array32
    tangents: Array32 | None


@dataclass(frozen=True)
class Pose:
    """One moment of a mesh: a `Posed` for each of its primitives. Those that do not move are the same arrays in every pose."""

    primitives: tuple[Posed, ...]


@dataclass(frozen=True)
class Morph:
    """Targets of the vertices from `start` on: (t, n, 3) displacements, weighted by the node's t weights."""

    start: int
    node: int
    positions: Array32
    normals: Array32 | None
    tangents: Array32 | None


@dataclass(frozen=True)
class Deformer:
    """What moves the vertices of one primitive.

    `base` as in the file; `influence` (n, p) weights of the p palette matrices; `flat` (m, 3) triangles whose vertices are
    theirs alone and have the triangle's normal.
    """

    base: Posed
    influence: csr_array
    morphs: tuple[Morph, ...]
    flat: NDArray[np.int32]

    def posed(self, palette: Array, weights: dict[int, Array]) -> Posed:
        """The vertices under (p, 4, 4) matrices and the nodes' morph weights."""
        positions, normals, tangents = _morphed(self.base, self.morphs, weights)
        blended = self._blended(palette[:, :3].reshape(-1, 12)).reshape(-1, 3, 4)
        linear = blended[:, :, :3]
        positions = _applied(linear, positions) + blended[:, :, 3]
        if 3 * len(self.flat) < len(normals):
            cofactors = self._blended(_normal_matrices(palette[:, :3, :3]).reshape(-1, 9)).reshape(-1, 3, 3)
            normals = _normalised(_applied(cofactors, normals))
        else:
            normals = np.empty_like(positions)
        if len(self.flat):
            normals[self.flat] = flat_normals(positions[self.flat])[:, None]
        if tangents is not None:
            along = _normalised(_applied(linear, np.ascontiguousarray(tangents[:, :3])))
            tangents = np.concatenate([along, tangents[:, 3:]], axis=1)
        return Posed(positions, normals, tangents)

    def _blended(self, rows: Array) -> Array32:
        return np.asarray(self.influence @ rows.astype(np.float32))


@dataclass(frozen=True)
class Rig:
    """How primitives follow nodes: palette matrix i is the world matrix of `palette_nodes[i]` times `inverse_binds[i]`."""

    hierarchy: Hierarchy
    palette_nodes: Indices
    inverse_binds: Array
    weights: dict[int, Array]
    deformers: dict[int, Deformer]
    clips: tuple[Clip, ...]

    def clip(self, name: str) -> Clip:
        for clip in self.clips:
            if clip.name == name:
                return clip
        raise ValueError(f"clip {name!r} does not exist, expected one of {', '.join(clip.name for clip in self.clips)}")

    def posed(self, clip: Clip | None, seconds: float, loop: bool) -> dict[int, Posed]:
        """The primitives that follow nodes, by their index, at one moment of a clip or at rest."""
        palette, weights = self._moment(clip, clip.moment(seconds, loop) if clip else 0.0)
        return {index: deformer.posed(palette, weights) for index, deformer in self.deformers.items()}

    def _moment(self, clip: Clip | None, seconds: float) -> tuple[Array, dict[int, Array]]:
        nodes, weights, local = self.hierarchy, self.weights, self.hierarchy.local
        if clip is not None:
            parts = {"translation": nodes.translations.copy(), "rotation": nodes.rotations.copy(), "scale": nodes.scales.copy()}
            moved = [track.nodes for track in clip.tracks if track.path != "weights"]
            weights = dict(weights)
            for track in clip.tracks:
                if track.path == "weights":
                    weights.update(zip(track.nodes.tolist(), track.at(seconds), strict=True))
                else:
                    parts[track.path][track.nodes] = track.at(seconds)
            if moved:
                changed, local = np.unique(np.concatenate(moved)), local.copy()
                local[changed] = matrices(*(part[changed] for part in parts.values()))
        with np.errstate(over="ignore", invalid="ignore"):  # scales of scales may leave the range of floats
            palette = nodes.world(local)[self.palette_nodes] @ self.inverse_binds
        return np.clip(np.nan_to_num(palette), -MAX_COORDINATE, MAX_COORDINATE), weights


def _morphed(base: Posed, morphs: tuple[Morph, ...], weights: dict[int, Array]) -> Posed:
    if not morphs:
        return base
    arrays = [None if array is None else array.copy() for array in base]
    for morph in morphs:
        weight = weights[morph.node].astype(np.float32)
        used = np.flatnonzero(weight)
        for array, deltas in zip(arrays, (morph.positions, morph.normals, morph.tangents), strict=True):
            if array is not None and deltas is not None and len(used):
                array[morph.start:morph.start + deltas.shape[1], :3] += np.tensordot(weight[used], deltas[used], 1)
    positions, normals, tangents = arrays
    assert positions is not None
    assert normals is not None
    return Posed(positions, normals, tangents)


def _normal_matrices(linear: Array) -> Array:
    """(p, 3, 3) matrices for normals: the inverse transposes up to a positive factor, finite where there is no inverse."""
    rows = linear / np.maximum(np.abs(linear).max(axis=(1, 2), keepdims=True), 1e-300)
    cofactors = np.stack([np.cross(rows[:, i], rows[:, j]) for i, j in ((1, 2), (2, 0), (0, 1))], axis=1)
    mirrored = np.einsum("ij,ij->i", cofactors[:, 0], rows[:, 0]) < 0
    size = np.maximum(np.linalg.norm(cofactors, axis=(1, 2)), 1e-300) / np.sqrt(3)
    return np.asarray(cofactors * (np.where(mirrored, -1.0, 1.0) / size)[:, None, None])


def _applied(linear: Array32, vectors: Array32) -> Array32:
    return np.asarray((linear @ vectors[:, :, None])[:, :, 0])


def _normalised(vectors: Array32) -> Array32:
    """Unit vectors in the same directions; +Y for those without a direction."""
    length = np.sqrt(np.einsum("ij,ij->i", vectors, vectors))[:, None]
    if length.size and length.min() > 1e-12:
        return np.asarray(vectors / length)
    return np.where(length > 1e-12, vectors / np.maximum(length, 1e-12), np.array([0, 1, 0], dtype=np.float32)).astype(np.float32)


def flat_normals(corners: Array32) -> Array32:
    """(m, 3) unit normals of triangles given by their (m, 3, 3) corners, counter-clockwise seen from outside."""
    a, b = (corners[:, i].astype(np.float64) - corners[:, 0] for i in (1, 2))
    normals = np.stack([a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1], a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2],
                        a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]], axis=1)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.where(length > 0, normals / np.where(length > 0, length, 1.0), [0.0, 1.0, 0.0]).astype(np.float32)

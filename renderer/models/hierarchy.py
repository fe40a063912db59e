"""Nodes that move with their parents: translations, quaternions (x, y, z, w) and scales to world matrices."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


def matrices(translations: Array, rotations: Array, scales: Array) -> Array:
    """(n, 4, 4) matrices that scale, then rotate, then translate, from (n, 3), unit quaternions (n, 4) and (n, 3)."""
    x, y, z, w = rotations.T
    result = np.zeros((len(rotations), 4, 4))
    result[:, 0, 0], result[:, 0, 1], result[:, 0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)
    result[:, 1, 0], result[:, 1, 1], result[:, 1, 2] = 2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)
    result[:, 2, 0], result[:, 2, 1], result[:, 2, 2] = 2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)
    result[:, :3, :3] *= scales[:, None, :]
    result[:, :3, 3] = translations
    result[:, 3, 3] = 1.0
    return result


def transform(position: Any, rotation: Any, scale: Any) -> Array:
    """(4, 4) world-from-model matrix of a translation, a unit quaternion x, y, z, w and a scale."""
    one = [np.asarray(part, dtype=np.float64)[None] for part in (position, rotation, np.broadcast_to(scale, 3))]
    return np.asarray(matrices(*one)[0])


def unit_quaternions(quaternions: Array) -> Array:
    """The same (..., 4) rotations with length 1; one without a length becomes no rotation."""
    largest = np.abs(quaternions).max(axis=-1, keepdims=True)
    scaled = np.where(largest > 0, quaternions / np.where(largest > 0, largest, 1.0), (0.0, 0.0, 0.0, 1.0))
    return np.asarray(scaled / np.linalg.norm(scaled, axis=-1, keepdims=True))


@dataclass(frozen=True)
class Hierarchy:
    """`parents` (n,) with -1 for roots; `levels` are the nodes by their depth; the rest are those of the nodes at rest."""

    parents: Indices
    levels: tuple[Indices, ...]
    translations: Array
    rotations: Array
    scales: Array
    local: Array

    @property
    def depth(self) -> int:
        return len(self.levels)

    def world(self, local: Array) -> Array:
        """(n, 4, 4) model-from-node matrices from (n, 4, 4) parent-from-node ones; of nodes in no level, what `local` has."""
        result = local.copy()
        for level in self.levels[1:]:
            result[level] = result[self.parents[level]] @ local[level]
        return result

    def ancestors(self, nodes: Indices) -> NDArray[np.bool_]:
        """(n,) whether a node is one of these or above one of them."""
        result = np.zeros(len(self.parents), dtype=bool)
        result[nodes] = True
        for level in self.levels[:0:-1]:
            result[self.parents[level[result[level]]]] = True
        return result

    def descendants(self, nodes: Indices) -> NDArray[np.bool_]:
        """(n,) whether a node is one of these or below one of them."""
        result = np.zeros(len(self.parents), dtype=bool)
        result[nodes] = True
        for level in self.levels[1:]:
            result[level] |= result[self.parents[level]]
        return result

    def only(self, nodes: NDArray[np.bool_]) -> Hierarchy:
        """One whose `world` computes these nodes alone."""
        return Hierarchy(self.parents, tuple(level[nodes[level]] for level in self.levels if nodes[level].any()),
                         self.translations, self.rotations, self.scales, self.local)

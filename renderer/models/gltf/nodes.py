"""A file's nodes as a tree."""

from __future__ import annotations

from typing import Any

import numpy as np

from renderer.models.gltf.document import GltfError, item, numbers
from renderer.models.hierarchy import Array, Hierarchy, Indices, matrices, unit_quaternions

MAX_DEPTH = 256


def hierarchy(document: Any) -> Hierarchy:
    """Every node with its place in the tree. Raises GltfError if the nodes are none, are no tree or have no finite place."""
    nodes = document.nodes or []
    parents = np.full(len(nodes), -1)
    for index, node in enumerate(nodes):
        for child in node.children or []:
            item(nodes, child, "node", f"node {index} children")
            if parents[child] != -1:
                raise GltfError(f"node {child}: is a child of node {parents[child]} and of node {index}, expected one parent")
            parents[child] = index
    translations = _vectors(nodes, "translation", [0.0, 0.0, 0.0])
    rotations = unit_quaternions(_vectors(nodes, "rotation", [0.0, 0.0, 0.0, 1.0]))
    scales = _vectors(nodes, "scale", [1.0, 1.0, 1.0])
    local = matrices(translations, rotations, scales)
    for index, node in enumerate(nodes):
        if node.matrix:
            local[index] = np.array(numbers(node.matrix, 16, "matrix", f"node {index}")).reshape(4, 4).T
            local[index, 3] = (0, 0, 0, 1)
    return Hierarchy(parents, _levels(nodes, parents), translations, rotations, scales, local)


def _vectors(nodes: list[Any], what: str, default: list[float]) -> Array:
    rows = [default if (values := getattr(node, what)) is None else numbers(values, len(default), what, f"node {index}")
            for index, node in enumerate(nodes)]
    return np.array(rows, dtype=np.float64).reshape(-1, len(default))


def _levels(nodes: list[Any], parents: Indices) -> tuple[Indices, ...]:
    levels = [np.flatnonzero(parents == -1)]
    while len(levels[-1]):
        if len(levels) > MAX_DEPTH:
            raise GltfError(f"node {levels[-1][0]}: is {len(levels)} levels deep, expected at most {MAX_DEPTH}")
        levels.append(np.array([child for index in levels[-1] for child in nodes[index].children or []], dtype=np.int64))
    reached = np.zeros(len(nodes), dtype=bool)
    reached[np.concatenate(levels)] = True
    if not reached.all():
        raise GltfError(f"node {np.flatnonzero(~reached)[0]}: is in a cycle of nodes, expected a tree")
    return tuple(levels[:-1])


def scene_nodes(document: Any) -> list[int]:
    """The nodes that the file shows, parents first: those of its scene, or all if it has none."""
    if not document.scenes:
        return list(range(len(document.nodes or [])))
    number = document.scene if document.scene is not None else 0
    roots = item(document.scenes, number, "scene", "model").nodes or []
    waiting = [root for root in reversed(roots) if item(document.nodes, root, "node", f"scene {number}") is not None]
    reached: dict[int, None] = {}
    while waiting:
        index = waiting.pop()
        if index not in reached:
            reached[index] = None
            waiting.extend(reversed(document.nodes[index].children or []))
    return list(reached)

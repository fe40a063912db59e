"""From a file to a mesh: what never moves is merged by material; what moves, by material too, follows the nodes as a rig."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from renderer.models.animation import Clip
from renderer.models.gltf.accessors import Buffers
from renderer.models.gltf.animations import Animations, skin
from renderer.models.gltf.document import GltfError, check_extensions, item, numbers, read
from renderer.models.gltf.geometry import Geometry
from renderer.models.gltf.images import Images
from renderer.models.gltf.materials import surface
from renderer.models.gltf.nodes import hierarchy, scene_nodes
from renderer.models.gltf.parts import Part, deformer, primitive
from renderer.models.gltf.primitives import MAX_TRIANGLES, MAX_VERTICES, TRIANGLES, Primitives, checked, mode_of
from renderer.models.hierarchy import Array, Indices
from renderer.models.mesh import Mesh, Primitive, Surface
from renderer.models.skeleton import MAX_COORDINATE, Deformer, Rig

MAX_MOVING_VERTICES = 100_000
MAX_PARTS = 65_536                  # primitives times the nodes that show them
MAX_PALETTE = 65_536                # joints of all skins and nodes


def load(path: Path) -> Mesh:
    """Load a `.glb`, or a `.gltf` with embedded buffers. Raises GltfError."""
    document = read(path)
    try:
        check_extensions(document)
        return _Model(document).mesh()
    except (IndexError, KeyError, TypeError, AttributeError) as error:
        raise GltfError(f"model {path.name!r} has a part of another type than expected: {error}") from None


class _Model:
    def __init__(self, document: Any) -> None:
        self._document = document
        self._buffers = Buffers(document)
        self._images = Images(document, self._buffers)
        self._primitives = Primitives(self._buffers)
        self._tree = hierarchy(document)
        with np.errstate(over="ignore", invalid="ignore"):     # scales of scales may leave the range of floats
            self._world = np.nan_to_num(self._tree.world(self._tree.local))
        self._surfaces: dict[int | None, Surface] = {}
        # Rigid nodes are joints of their own, in the first places of the palette.
        self._palette: list[tuple[Indices, Array]] = [
            (np.arange(len(self._world)), np.tile(np.eye(4), (len(self._world), 1, 1)))]
        self._skins: dict[int, tuple[int, Indices, NDArray[np.bool_]]] = {}
        self._weights: dict[int, Array] = {}
        self._moving = np.zeros(len(self._world), dtype=bool)
        self._morphing: set[int] = set()

    def mesh(self) -> Mesh:
        shown = [index for index in scene_nodes(self._document) if self._document.nodes[index].mesh is not None]
        self._check_sizes(shown)
        for index in shown:
            self._note_morph_weights(index)
        clips = Animations(self._document, self._buffers, {node: len(w) for node, w in self._weights.items()}).clips()
        self._note_motion(clips)
        groups: dict[tuple[int | None, bool], list[Part]] = {}
        for index in shown:
            self._collect(index, groups)
        if not groups:
            raise GltfError("model has no triangles with an area in its scene")
        return self._assembled(groups, clips)

    def _shown_primitives(self, node: int) -> list[tuple[Any, str]]:
        """The primitives that a node shows, without points and lines."""
        number = self._document.nodes[node].mesh
        parts = [(checked(one, part), part) for index, one in enumerate(self._document.meshes[number].primitives)
                 for part in [f"mesh {number} primitive {index}"]]
        return [(one, part) for one, part in parts if mode_of(one) >= TRIANGLES]

    def _check_sizes(self, shown: list[int]) -> None:
        sizes = {"triangles": 0, "vertices": 0, "parts": 0}
        for index in shown:
            mesh = item(self._document.meshes, self._document.nodes[index].mesh, "mesh", f"node {index}")
            sizes["parts"] += len(mesh.primitives)
            _check(sizes)
            for one, part in self._shown_primitives(index):
                triangles, vertices = self._primitives.triangles_and_vertices(one, part)
                sizes["triangles"] += triangles
                sizes["vertices"] += vertices
                _check(sizes)

    def _note_morph_weights(self, node: int) -> None:
        parts = self._shown_primitives(node)
        counts = {len(one.targets or []) for one, _ in parts}
        if len(counts) > 1:
            raise GltfError(f"node {node}: its mesh has primitives of {sorted(counts)} morph targets, expected as many in each")
        if count := max(counts, default=0):
            given = self._document.nodes[node].weights or self._document.meshes[self._document.nodes[node].mesh].weights
            self._weights[node] = np.array(numbers(given or [0] * count, count, "weights", f"node {node}"))

    def _note_motion(self, clips: tuple[Clip, ...]) -> None:
        tracks = [track for clip in clips for track in clip.tracks]
        moved = [track.nodes for track in tracks if track.path != "weights"]
        if moved:
            self._moving = self._tree.descendants(np.concatenate(moved))
        self._morphing = {node for track in tracks if track.path == "weights" for node in track.nodes.tolist()}

    def _collect(self, node: int, groups: dict[tuple[int | None, bool], list[Part]]) -> None:
        for one, name in self._shown_primitives(node):
            geometry = self._primitives.get(one, self._surface(one.material), name)
            if geometry is None:
                continue
            part, moves = self._part(node, geometry, name)
            moves = moves or node in self._morphing
            if moves or geometry.joints is not None or np.linalg.matrix_rank(self._world[node, :3, :3]) >= 2:
                groups.setdefault((one.material, moves), []).append(part)

    def _surface(self, material: Any) -> Surface:
        if material not in self._surfaces:
            self._surfaces[material] = surface(self._document, material, self._images)
        return self._surfaces[material]

    def _part(self, node: int, geometry: Geometry, name: str) -> tuple[Part, bool]:
        """The part, and whether a clip moves a node that it follows."""
        if self._document.nodes[node].skin is None or geometry.joints is None or geometry.weights is None:
            rigid = np.full((len(geometry.positions), 1), node)
            mirrored = bool(np.linalg.det(self._world[node, :3, :3]) < 0)
            return Part(geometry, node, rigid, np.ones(rigid.shape, np.float32), mirrored), bool(self._moving[node])
        first, joints, joint_mirrored = self._skin(self._document.nodes[node].skin, f"node {node}")
        own = np.where(geometry.weights > 0, geometry.joints, 0)
        if own.max() >= len(joints):
            raise GltfError(f"{name}: joint {own.max()}, expected less than the {len(joints)} of skin "
                            f"{self._document.nodes[node].skin}")
        heaviest = np.take_along_axis(own, geometry.weights.argmax(axis=1)[:, None], axis=1)
        return (Part(geometry, node, own + first, geometry.weights, bool(joint_mirrored[heaviest].mean() > 0.5)),
                bool(self._moving[joints[np.unique(own)]].any()))

    def _skin(self, index: Any, part: str) -> tuple[int, Indices, NDArray[np.bool_]]:
        """Where a skin's joints begin in the palette, the joints, and which of them mirror what follows them."""
        if index not in self._skins:
            joints, binds = skin(self._document, index, self._buffers, part)
            first = sum(len(nodes) for nodes, _ in self._palette)
            if first + len(joints) > MAX_PALETTE:
                raise GltfError(f"skin {index}: with it the model has {first + len(joints)} nodes and joints, expected at most "
                                f"{MAX_PALETTE}")
            self._palette.append((joints, binds))
            self._skins[index] = (first, joints, np.linalg.det((self._world[joints] @ binds)[:, :3, :3]) < 0)
        return self._skins[index]

    def _assembled(self, groups: dict[tuple[int | None, bool], list[Part]], clips: tuple[Clip, ...]) -> Mesh:
        nodes, binds = (np.concatenate([entry[i] for entry in self._palette]) for i in range(2))
        palette = np.clip(self._world[nodes] @ binds, -MAX_COORDINATE, MAX_COORDINATE)
        primitives: list[Primitive] = []
        deformers: dict[int, Deformer] = {}
        for (material, moves), parts in groups.items():
            moving = deformer(parts, len(nodes))
            if moves:
                deformers[len(primitives)] = moving
            primitives.append(primitive(parts, self._surface(material), moving.posed(palette, self._weights)))
            if not np.abs(primitives[-1].positions).max() <= MAX_COORDINATE:
                raise GltfError(f"material {material}: positions in the scene reach "
                                f"{np.abs(primitives[-1].positions).max():g}, expected at most {MAX_COORDINATE:g}")
        return Mesh(tuple(primitives), self._rig(deformers, nodes, binds, clips) if deformers else None)

    def _rig(self, deformers: dict[int, Deformer], nodes: Indices, binds: Array, clips: tuple[Clip, ...]) -> Rig:
        """The rig of what moves, with the part of the palette that it needs."""
        vertices = sum(len(one.base.positions) for one in deformers.values())
        if vertices > MAX_MOVING_VERTICES:
            raise GltfError(f"model has {vertices} vertices that move, expected at most {MAX_MOVING_VERTICES}")
        used = np.unique(np.concatenate([one.influence.indices for one in deformers.values()]))
        own = {index: replace(one, influence=one.influence[:, used]) for index, one in deformers.items()}
        return Rig(self._tree.only(self._tree.ancestors(nodes[used])), nodes[used], binds[used], self._weights, own, clips)


def _check(sizes: dict[str, int]) -> None:
    for what, most in (("triangles", MAX_TRIANGLES), ("vertices", MAX_VERTICES), ("parts", MAX_PARTS)):
        if sizes[what] > most:
            raise GltfError(f"model has {sizes[what]} {what} or more, expected at most {most}")

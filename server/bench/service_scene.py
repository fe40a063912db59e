"""What the whole-service benchmark renders: the papers' five objects, rows of any number of objects, and a mesh of any size."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pygltflib
from numpy.typing import NDArray

from renderer.models.mesh import BUILT_IN
from renderer.scene import Scene
from server.demo.landscape import CAMERA_HEIGHT_M
from server.demo.sample_scene import GROUND_Y, sample_scene

KNOT = "bench-knot"
KNOT_TRIANGLES = 70_000
KNOT_HEIGHT = 0.6           # metres, of the object that stands in the scene
MIN_TRIANGLES, MAX_TRIANGLES = 500, 500_000
SECTIONS_PER_SIDE = 4       # of the knot's tube, which is that much longer than it is round
TEAPOT = {"base_color": [0.72, 0.09, 0.06], "metallic": 0.0, "roughness": 0.25}
BOX = {"base_color": [0.10, 0.28, 0.62], "metallic": 0.0, "roughness": 0.6}
GLOSSY_METAL = {"base_color": [0.95, 0.75, 0.45], "metallic": 1.0, "roughness": 0.25}
MIRROR = {"base_color": [0.95, 0.95, 0.95], "metallic": 1.0, "roughness": 0.0}
KNOT_MATERIAL = {"base_color": [0.25, 0.45, 0.20], "metallic": 0.0, "roughness": 0.4}
Points = NDArray[np.float32]


def five_objects() -> dict[str, Any]:
    """Teapot, knot, diffuse box, cylinder of glossy metal and mirror sphere, all of which cast shadows, as scene JSON."""
    teapot, _, box = sample_scene()["objects"]
    return _scene([teapot, knot_object((-1.35, -2.5)), box,
                   _object("cylinder", "cylinder", (-0.7, -1.9), (0.5, 0.8, 0.5), 0.4, GLOSSY_METAL),
                   _object("mirror", "sphere", (0.7, -1.8), (0.6, 0.6, 0.6), 0.3, MIRROR)])


def objects_around(count: int) -> dict[str, Any]:
    """So many objects of five kinds in turn, on circles of 2.2 m, 3.4 m … around the camera, 16 on each, as scene JSON."""
    kinds = (("teapot", (0.6, 0.6, 0.6), 0.0, TEAPOT), ("box", (0.5, 0.5, 0.5), 0.25, BOX),
             ("cylinder", (0.4, 0.7, 0.4), 0.35, GLOSSY_METAL), ("sphere", (0.6, 0.6, 0.6), 0.3, MIRROR),
             ("sphere", (0.5, 0.5, 0.5), 0.25, KNOT_MATERIAL))
    placed = []
    for index in range(count):
        mesh, scale, height, material = kinds[index % len(kinds)]
        circle, turn = divmod(index, 16)
        radius, angle = 2.2 + 1.2 * circle, 2 * math.pi * (turn + 0.5 * (circle % 2)) / 16
        place = (radius * math.sin(angle), -radius * math.cos(angle))
        placed.append(_object(f"{mesh}-{index}", mesh, place, scale, height, material))
    return _scene(placed)


def knot_object(place: tuple[float, float], asset: str = KNOT) -> dict[str, Any]:
    """The knot of `knot_glb`, standing on the ground at (x, z)."""
    return _object("knot", f"asset:{asset}", place, (KNOT_HEIGHT,) * 3, KNOT_HEIGHT / 2, KNOT_MATERIAL)


def knot_alone(asset: str) -> dict[str, Any]:
    """That asset alone in front of the camera, as scene JSON."""
    return _scene([knot_object((0.0, -2.2), asset)])


def triangles_of(scene: dict[str, Any], assets: dict[str, int]) -> int:
    """Of all objects; `assets` has those of uploaded models by name, the teapot's among them."""
    counted = {name: make().triangle_count for name, make in BUILT_IN.items()} | assets
    return sum(counted[placed["mesh"].removeprefix("asset:")] for placed in scene["objects"])


def knot_glb(triangles: int) -> tuple[bytes, int]:
    """A trefoil knot, a closed tube 1 high around the origin, as a GLB, and its number of triangles: the nearest that a grid
    of quads gives, within 2 % from 1000 on. Raises ValueError for a number out of range."""
    if not MIN_TRIANGLES <= triangles <= MAX_TRIANGLES:
        raise ValueError(f"triangles is {triangles}, expected {MIN_TRIANGLES} to {MAX_TRIANGLES}")
    sides = max(3, round(math.sqrt(triangles / (2 * SECTIONS_PER_SIDE))))
    sections = max(4, min(round(triangles / (2 * sides)), MAX_TRIANGLES // (2 * sides)))
    positions, normals = _tube(sections, sides)
    indices = _grid(sections, sides)
    return _glb(positions, normals, indices), len(indices)


def _tube(sections: int, sides: int) -> tuple[Points, Points]:
    t = np.arange(sections) / sections * 2 * np.pi
    centre = np.stack([np.sin(t) + 2 * np.sin(2 * t), np.cos(t) - 2 * np.cos(2 * t), -np.sin(3 * t)], axis=1)
    along = np.stack([np.cos(t) + 4 * np.cos(2 * t), -np.sin(t) + 4 * np.sin(2 * t), -3 * np.cos(3 * t)], axis=1)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    across = np.cross(along, centre)        # never parallel on this knot, so the frame turns smoothly and closes
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    beside = np.cross(along, across)
    angle = (np.arange(sides) / sides * 2 * np.pi)[None, :, None]
    normals = np.cos(angle) * across[:, None] + np.sin(angle) * beside[:, None]
    positions = centre[:, None] + 0.55 * normals
    height = positions[..., 1].max() - positions[..., 1].min()
    middle = (positions[..., 1].max() + positions[..., 1].min()) / 2
    positions = (positions - [0.0, middle, 0.0]) / height
    return positions.reshape(-1, 3).astype(np.float32), normals.reshape(-1, 3).astype(np.float32)


def _grid(sections: int, sides: int) -> NDArray[np.uint32]:
    section, side = np.meshgrid(np.arange(sections), np.arange(sides), indexing="ij")
    a = section * sides + side
    b = (section + 1) % sections * sides + side
    c = (section + 1) % sections * sides + (side + 1) % sides
    d = section * sides + (side + 1) % sides
    return np.stack([np.stack([a, d, c], -1), np.stack([a, c, b], -1)], axis=-2).reshape(-1, 3).astype(np.uint32)


def _glb(positions: Points, normals: Points, indices: NDArray[np.uint32]) -> bytes:
    blobs = [positions.tobytes(), normals.tobytes(), indices.tobytes()]
    starts = np.cumsum([0, *map(len, blobs)]).tolist()
    vector = {"componentType": pygltflib.FLOAT, "count": len(positions), "type": pygltflib.VEC3}
    box = {"min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist()}
    index = {"componentType": pygltflib.UNSIGNED_INT, "count": indices.size, "type": pygltflib.SCALAR}
    model = pygltflib.GLTF2(
        scene=0, scenes=[pygltflib.Scene(nodes=[0])], nodes=[pygltflib.Node(mesh=0)],
        meshes=[pygltflib.Mesh(primitives=[pygltflib.Primitive(attributes=pygltflib.Attributes(POSITION=0, NORMAL=1), indices=2)])],
        accessors=[pygltflib.Accessor(bufferView=0, **vector, **box), pygltflib.Accessor(bufferView=1, **vector),
                   pygltflib.Accessor(bufferView=2, **index)],
        bufferViews=[pygltflib.BufferView(buffer=0, byteOffset=start, byteLength=len(blob))
                     for start, blob in zip(starts, blobs, strict=False)],
        buffers=[pygltflib.Buffer(byteLength=starts[-1])])
    model.set_binary_blob(b"".join(blobs))
    return b"".join(model.save_to_bytes())


def _object(name: str, mesh: str, place: tuple[float, float], scale: tuple[float, ...], height: float,
            material: dict[str, Any]) -> dict[str, Any]:
    return {"id": name, "mesh": mesh, "position": [place[0], GROUND_Y + height, place[1]], "scale": list(scale),
            "material": material, "casts_shadow": True}


def _scene(objects: list[dict[str, Any]]) -> dict[str, Any]:
    return Scene.model_validate({"camera_height": CAMERA_HEIGHT_M, "objects": objects}).model_dump(mode="json")

"""Loads a glTF 2.0 model as one static mesh: hierarchy applied, primitives of one material merged.

Parsed by pygltflib; everything that reaches the renderer is checked here, because models are uploaded by strangers: sizes,
index ranges, finite positions, no references outside the file.
"""

from __future__ import annotations

import base64
import io
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pygltflib
from numpy.typing import NDArray
from PIL import Image

from renderer.mesh import Mesh, Points, Primitive, Surface, Triangles

MAX_FILE_BYTES = 64 << 20
MAX_TRIANGLES = 500_000
MAX_TEXTURE_SIZE = 4096
MAX_NODE_DEPTH = 64
SUPPORTED_EXTENSIONS = {"KHR_materials_emissive_strength"}
_COMPONENTS = {5120: np.int8, 5121: np.uint8, 5122: np.int16, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_TRIANGLES_MODE = 4


class GltfError(ValueError):
    """The model cannot be used; the message names the part."""


def load(path: Path) -> Mesh:
    """Load a `.glb`, or a `.gltf` with embedded buffers. Raises GltfError."""
    try:
        size = path.stat().st_size
        if size > MAX_FILE_BYTES:
            raise GltfError(f"model {path.name!r} has {size} bytes, expected at most {MAX_FILE_BYTES}")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            document = pygltflib.GLTF2().load(str(path))
    except GltfError:
        raise
    except FileNotFoundError:
        raise GltfError(f"model {str(path)!r} does not exist") from None
    except Exception as error:  # pygltflib raises whatever its parsing runs into
        raise GltfError(f"model {path.name!r} is not glTF 2.0: {error}") from None
    if document is None:
        raise GltfError(f"model {path.name!r} is not glTF 2.0")
    try:
        return _Model(document).mesh()
    except (IndexError, KeyError, TypeError, AttributeError) as error:
        raise GltfError(f"model {path.name!r} refers to a part that it does not have: {error}") from None


class _Model:
    def __init__(self, document: Any) -> None:
        self.document = document
        unsupported = sorted(set(document.extensionsRequired or []) - SUPPORTED_EXTENSIONS)
        if unsupported:
            raise GltfError(f"model requires {', '.join(unsupported)}, which is not supported")
        self._buffers = [self._buffer(index, buffer) for index, buffer in enumerate(document.buffers)]
        self._images: dict[int, NDArray[np.uint8]] = {}

    def _buffer(self, index: int, buffer: Any) -> bytes:
        if buffer.uri is None:
            blob = self.document.binary_blob()
            if blob is None:
                raise GltfError(f"buffer {index} has no data")
            return bytes(blob)
        return _data_uri(buffer.uri, f"buffer {index}")

    def _view(self, index: int, part: str) -> tuple[bytes, int]:
        view = self.document.bufferViews[index]
        start = view.byteOffset or 0
        data = self._buffers[view.buffer][start:start + view.byteLength]
        if start < 0 or len(data) != view.byteLength:
            raise GltfError(f"{part}: buffer view {index} ends outside its buffer")
        return data, view.byteStride or 0

    def accessor(self, index: int, part: str) -> NDArray[Any]:
        """(count, width) values; normalised integers become floats."""
        accessor = self.document.accessors[index]
        dtype, width = np.dtype(_COMPONENTS[accessor.componentType]), _WIDTHS[accessor.type]
        if accessor.sparse is not None:
            raise GltfError(f"{part}: sparse accessor {index} is not supported")
        if accessor.bufferView is None:
            return np.zeros((accessor.count, width), dtype)
        data, stride = self._view(accessor.bufferView, part)
        start, item = accessor.byteOffset or 0, dtype.itemsize * width
        stride = stride or item
        if accessor.count < 1 or start < 0 or stride < item or start + stride * (accessor.count - 1) + item > len(data):
            raise GltfError(f"{part}: accessor {index} ends outside its buffer view")
        values = np.ndarray((accessor.count, width), dtype, data, start, (stride, dtype.itemsize)).copy()
        if accessor.normalized and dtype.kind in "iu":
            return np.asarray(np.maximum(values / float(np.iinfo(dtype.name).max), -1.0), dtype=np.float32)
        return values

    def mesh(self) -> Mesh:
        by_material: dict[int | None, list[tuple[Points, Points, Points, Triangles]]] = {}
        scene = self.document.scenes[self.document.scene or 0] if self.document.scenes else None
        roots = scene.nodes if scene is not None else range(len(self.document.nodes))
        for root in roots:
            self._collect(root, np.eye(4), by_material, depth=0)
        if not by_material:
            raise GltfError("model has no triangles in its scene")
        primitives = tuple(self._merged(parts, self.surface(material)) for material, parts in by_material.items())
        mesh = Mesh(primitives)
        if mesh.triangle_count > MAX_TRIANGLES:
            raise GltfError(f"model has {mesh.triangle_count} triangles, expected at most {MAX_TRIANGLES}")
        return mesh

    def _collect(self, index: int, parent: NDArray[np.float64], out: dict[Any, list[Any]], depth: int) -> None:
        if depth > MAX_NODE_DEPTH:
            raise GltfError(f"node {index}: hierarchy is deeper than {MAX_NODE_DEPTH}, or has a cycle")
        node = self.document.nodes[index]
        world = parent @ _node_matrix(node)
        if node.mesh is not None:
            for number, primitive in enumerate(self.document.meshes[node.mesh].primitives):
                part = f"mesh {node.mesh} primitive {number}"
                if (primitive.mode if primitive.mode is not None else _TRIANGLES_MODE) == _TRIANGLES_MODE:
                    out.setdefault(primitive.material, []).append(self._primitive(primitive, world, part))
        for child in node.children or []:
            self._collect(child, world, out, depth + 1)

    def _primitive(self, primitive: Any, world: NDArray[np.float64],
                   part: str) -> tuple[Points, Points, Points, Triangles]:
        if (primitive.extensions or {}).get("KHR_draco_mesh_compression"):
            raise GltfError(f"{part}: KHR_draco_mesh_compression is not supported")
        attributes = primitive.attributes
        if attributes.POSITION is None:
            raise GltfError(f"{part}: has no POSITION")
        positions = self.accessor(attributes.POSITION, part).astype(np.float64)
        if positions.shape[1] != 3 or not np.isfinite(positions).all():
            raise GltfError(f"{part}: POSITION has values that are not finite, expected finite x, y, z")
        count = len(positions)
        indices = (np.arange(count) if primitive.indices is None
                   else self.accessor(primitive.indices, part).astype(np.int64).ravel())
        if indices.size % 3 or indices.max(initial=0) >= count:
            raise GltfError(f"{part}: index {indices.max(initial=0)} of {indices.size}, expected triangles of {count} vertices")
        triangles = indices.reshape(-1, 3).astype(np.int32)
        uvs = (np.zeros((count, 2)) if attributes.TEXCOORD_0 is None
               else np.nan_to_num(self.accessor(attributes.TEXCOORD_0, part).astype(np.float64)))
        if attributes.NORMAL is None:
            positions, uvs = positions[triangles].reshape(-1, 3), uvs[triangles].reshape(-1, 2)
            triangles = np.arange(len(positions), dtype=np.int32).reshape(-1, 3)
            edges = positions.reshape(-1, 3, 3)
            normals = np.repeat(np.cross(edges[:, 1] - edges[:, 0], edges[:, 2] - edges[:, 0]), 3, axis=0)
        else:
            normals = np.nan_to_num(self.accessor(attributes.NORMAL, part).astype(np.float64))
        if len(uvs) != len(positions) or len(normals) != len(positions):
            raise GltfError(f"{part}: {len(positions)} positions, {len(normals)} normals, {len(uvs)} texture coordinates, "
                            f"expected as many of each")
        linear = world[:3, :3]
        if np.linalg.det(linear) < 0:
            triangles = triangles[:, ::-1]
        cofactor = np.linalg.inv(linear).T if abs(np.linalg.det(linear)) > 1e-12 else linear
        return (np.ascontiguousarray(positions @ linear.T + world[:3, 3], dtype=np.float32),
                _normalised(normals @ cofactor.T), np.ascontiguousarray(uvs, dtype=np.float32), triangles)

    @staticmethod
    def _merged(parts: list[tuple[Points, Points, Points, Triangles]], surface: Surface) -> Primitive:
        offsets = np.cumsum([0] + [len(part[0]) for part in parts[:-1]])
        arrays = [np.ascontiguousarray(np.concatenate([part[i] for part in parts])) for i in range(3)]
        triangles = np.concatenate([part[3] + offset for part, offset in zip(parts, offsets, strict=True)])
        return Primitive(arrays[0], arrays[1], arrays[2], triangles.astype(np.int32), surface)

    def surface(self, index: int | None) -> Surface:
        if index is None:
            return Surface(base_color=(1.0, 1.0, 1.0, 1.0), metallic=1.0, roughness=1.0)
        material = self.document.materials[index]
        pbr = material.pbrMetallicRoughness or pygltflib.PbrMetallicRoughness()
        strength = ((material.extensions or {}).get("KHR_materials_emissive_strength") or {}).get("emissiveStrength", 1.0)
        emissive = material.emissiveFactor or (0.0, 0.0, 0.0)
        r, g, b, a = (float(np.clip(c, 0, 1)) for c in (pbr.baseColorFactor or (1, 1, 1, 1)))
        metallic, roughness = pbr.metallicFactor, pbr.roughnessFactor
        return Surface(
            base_color=(r, g, b, a), metallic=1.0 if metallic is None else float(np.clip(metallic, 0, 1)),
            roughness=1.0 if roughness is None else float(np.clip(roughness, 0, 1)),
            emissive=(emissive[0] * strength, emissive[1] * strength, emissive[2] * strength),
            base_color_texture=self._texture(pbr.baseColorTexture), emissive_texture=self._texture(material.emissiveTexture),
            metallic_roughness_texture=self._texture(pbr.metallicRoughnessTexture),
            double_sided=bool(material.doubleSided),
            alpha_cutoff=(material.alphaCutoff or 0.5) if material.alphaMode == "MASK" else None)

    def _texture(self, info: Any) -> NDArray[np.uint8] | None:
        if info is None:
            return None
        source = self.document.textures[info.index].source
        if source is None:
            return None
        if source not in self._images:
            self._images[source] = self._image(source)
        return self._images[source]

    def _image(self, index: int) -> NDArray[np.uint8]:
        image = self.document.images[index]
        data = (self._view(image.bufferView, f"image {index}")[0] if image.bufferView is not None
                else _data_uri(image.uri or "", f"image {index}"))
        try:
            with Image.open(io.BytesIO(data), formats=("PNG", "JPEG")) as picture:
                if max(picture.size) > MAX_TEXTURE_SIZE:
                    raise GltfError(f"image {index} is {picture.size[0]}x{picture.size[1]}, expected at most "
                                    f"{MAX_TEXTURE_SIZE} on a side")
                return np.asarray(picture.convert("RGBA"))
        except (OSError, Image.DecompressionBombError, SyntaxError) as error:
            raise GltfError(f"image {index} is not a PNG or JPEG: {error}") from None


def _data_uri(uri: str, part: str) -> bytes:
    head, _, body = uri.partition(",")
    if not head.startswith("data:") or not head.endswith(";base64"):
        raise GltfError(f"{part}: uri {uri[:80]!r} leads outside the file, expected embedded data")
    return base64.b64decode(body)


def _node_matrix(node: Any) -> NDArray[np.float64]:
    if node.matrix:
        return np.array(node.matrix, dtype=np.float64).reshape(4, 4).T
    return transform(node.translation or (0, 0, 0), node.rotation or (0, 0, 0, 1), node.scale or (1, 1, 1))


def transform(position: Any, rotation: Any, scale: Any) -> NDArray[np.float64]:
    """(4, 4) world-from-model matrix of a translation, a unit quaternion x, y, z, w and a scale."""
    x, y, z, w = (float(c) for c in rotation)
    matrix = np.eye(4)
    matrix[:3, :3] = np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]) * np.asarray(scale, dtype=np.float64)
    matrix[:3, 3] = position
    return matrix


def _normalised(normals: NDArray[np.float64]) -> Points:
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.ascontiguousarray(np.where(length > 1e-12, normals / np.maximum(length, 1e-12), [0.0, 1.0, 0.0]),
                                dtype=np.float32)

"""Builds glTF models in memory."""

from __future__ import annotations

import io
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from renderer.models.gltf import load
from renderer.models.mesh import Mesh

COMPONENTS = {"int8": 5120, "uint8": 5121, "int16": 5122, "uint16": 5123, "uint32": 5125, "float32": 5126}
TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "f4")
TURN = np.sqrt(0.5)     # sine and cosine of half a right angle


def glb(document: dict[str, Any], binary: bytes = b"") -> bytes:
    body = json.dumps(document).encode()
    body += b" " * (-len(body) % 4)
    binary += b"\0" * (-len(binary) % 4)
    chunks = struct.pack("<I4s", len(body), b"JSON") + body + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def triangle(**changes: Any) -> bytes:
    """One triangle; `changes` replace top-level members of its JSON."""
    model = Model()
    model.show({"attributes": {"POSITION": model.accessor(CORNERS)}, "indices": model.accessor(np.array([0, 1, 2], "u2"))})
    model.json.update(changes)
    return model.bytes()


def png(pixels: np.ndarray[Any, Any]) -> bytes:
    """An image file of (height, width[, channels]) uint8 or uint16 pixels."""
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "png")
    return file.getvalue()


class Model:
    """A document that grows; `json` may be changed at will before it is written."""

    def __init__(self, **members: Any) -> None:
        self.json: dict[str, Any] = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
                                     "meshes": [], "accessors": [], "bufferViews": [], "buffers": [], **members}
        self.binary = b""

    def add(self, kind: str, **item: Any) -> int:
        """Append an item to a list of the document."""
        self.json.setdefault(kind, []).append(item)
        return len(self.json[kind]) - 1

    def view(self, data: bytes) -> int:
        start = len(self.binary)
        self.binary += data + b"\0" * (-len(data) % 4)
        return self.add("bufferViews", buffer=0, byteOffset=start, byteLength=len(data))

    def accessor(self, values: Any, **members: Any) -> int:
        """Floats, unless the values are an array of another type."""
        array = values if isinstance(values, np.ndarray) else np.array(values, "f4")
        return self.add("accessors", bufferView=self.view(array.tobytes()), componentType=COMPONENTS[str(array.dtype)],
                        count=len(array), type=TYPES[array[0].size], **members)

    def texture(self, pixels: np.ndarray[Any, Any], **members: Any) -> dict[str, int]:
        """A texture's reference."""
        return {"index": self.add("textures", source=self.add("images", bufferView=self.view(png(pixels)), mimeType="image/png"),
                                  **members)}

    def show(self, *primitives: dict[str, Any], **members: Any) -> int:
        """A mesh of these primitives."""
        return self.add("meshes", primitives=list(primitives), **members)

    def clip(self, node: int, path: str, times: Any, values: Any, interpolation: str = "LINEAR", **members: Any) -> int:
        """An animation of one channel."""
        sampler = {"input": self.accessor(times), "output": self.accessor(values), "interpolation": interpolation}
        return self.add("animations", samplers=[sampler], channels=[{"sampler": 0, "target": {"node": node, "path": path}}],
                        **members)

    def bytes(self) -> bytes:
        return glb({**self.json, "buffers": self.json["buffers"] or [{"byteLength": len(self.binary)}]}, self.binary)

    def load(self, folder: Path) -> Mesh:
        (folder / "m.glb").write_bytes(self.bytes())
        return load(folder / "m.glb")


def one_triangle(material: dict[str, Any] | None = None, **attributes: Any) -> Model:
    """A triangle with these attributes beside its positions."""
    model = Model()
    accessors = {name: model.accessor(values) for name, values in {"POSITION": CORNERS, **attributes}.items()}
    model.show({"attributes": accessors, **({} if material is None else {"material": model.add("materials", **material)})})
    return model


def bent_bar() -> Model:
    """A bar from y = 0 to 2 of two joints, at 0 and at 1; clip 'bend' turns the upper one by 90 degrees about +Z in 1 s."""
    points = np.array([[x, y, 0] for y in (0, 1, 2) for x in (-0.1, 0.1)], "f4")
    joints = np.array([[0, 1, 0, 0]] * 6, "u1")
    weights = np.array([[1, 0, 0, 0]] * 2 + [[0.5, 0.5, 0, 0]] * 2 + [[0, 1, 0, 0]] * 2, "f4")
    model = Model(nodes=[{"mesh": 0, "skin": 0, "translation": [9, 9, 9]}, {"children": [2]}, {"translation": [0, 1, 0]}],
                  scenes=[{"nodes": [0, 1]}])
    attributes = {"POSITION": points, "NORMAL": np.tile(np.array([0, 0, 1], "f4"), (6, 1)), "JOINTS_0": joints,
                  "WEIGHTS_0": weights}
    model.show({"attributes": {name: model.accessor(values) for name, values in attributes.items()},
                "indices": model.accessor(np.array([0, 1, 2, 1, 3, 2, 2, 3, 4, 3, 5, 4], "u1"))})
    down = np.eye(4)
    down[3, 1] = -1     # glTF matrices are in column order
    model.add("skins", joints=[1, 2], inverseBindMatrices=model.accessor(np.array([np.eye(4), down], "f4").reshape(2, 16)))
    model.clip(2, "rotation", [0, 1], [[0, 0, 0, 1], [0, 0, TURN, TURN]], name="bend")
    return model

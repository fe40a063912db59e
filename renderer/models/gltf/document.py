"""A glTF file's JSON and binary chunk, bounded before they are decoded, and access to their parts by checked references."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pygltflib

from renderer.models.gltf.schema import SchemaError, built

MAX_FILE_BYTES = 64 << 20
MAX_JSON_VALUES = 1_000_000
MAX_ITEMS = {"accessors": 65_536, "animations": 256, "bufferViews": 65_536, "buffers": 256, "images": 256, "materials": 1024,
             "meshes": 16_384, "nodes": 16_384, "samplers": 1024, "scenes": 256, "skins": 256, "textures": 1024}
SUPPORTED_EXTENSIONS = {"KHR_materials_clearcoat", "KHR_materials_emissive_strength", "KHR_materials_unlit",
                        "KHR_mesh_quantization", "KHR_texture_transform"}
_HEADER = struct.Struct("<4sII")
_CHUNK = struct.Struct("<I4s")


class GltfError(ValueError):
    """The model cannot be used; the message names the part."""


def read(path: Path) -> Any:
    """The `pygltflib.GLTF2` of a `.glb`, or of a `.gltf` with embedded buffers. Raises GltfError."""
    try:
        size = path.stat().st_size
        if size > MAX_FILE_BYTES:
            raise GltfError(f"model {path.name!r} has {size} bytes, expected at most {MAX_FILE_BYTES}")
        data = path.read_bytes()
    except FileNotFoundError:
        raise GltfError(f"model {str(path)!r} does not exist") from None
    except OSError as error:
        raise GltfError(f"model {path.name!r} cannot be read: {error.strerror}") from None
    try:
        text, binary = _chunks(data) if path.suffix.lower() != ".gltf" else (data, None)
        document = _parsed(text)
    except GltfError as error:
        raise GltfError(f"model {path.name!r} is not glTF 2.0: {error}") from None
    document.set_binary_blob(binary)
    return document


def check_extensions(document: Any) -> None:
    unsupported = sorted({str(name) for name in document.extensionsRequired or []} - SUPPORTED_EXTENSIONS)
    if unsupported:
        raise GltfError(f"model requires {printable(', '.join(unsupported), 200)}, which is not supported")


def _chunks(data: bytes) -> tuple[bytes, bytes | None]:
    """The JSON and the binary chunk of a GLB."""
    if len(data) < _HEADER.size:
        raise GltfError(f"it has {len(data)} bytes, expected a header of {_HEADER.size}")
    magic, version, length = _HEADER.unpack_from(data)
    if magic != b"glTF" or version != 2:
        raise GltfError(f"it begins with {magic!r} version {version}, expected b'glTF' version 2")
    if length != len(data):
        raise GltfError(f"its header names {length} bytes, the file has {len(data)}")
    chunks: dict[bytes, bytes] = {}
    start = _HEADER.size
    while start < length:
        if start + _CHUNK.size > length:
            raise GltfError(f"a chunk begins {length - start} bytes before the end, expected at least {_CHUNK.size}")
        size, kind = _CHUNK.unpack_from(data, start)
        start += _CHUNK.size
        if size > length - start:
            raise GltfError(f"chunk {kind!r} names {size} bytes, expected at most the {length - start} that follow")
        if not chunks and kind != b"JSON":
            raise GltfError(f"its first chunk is {kind!r}, expected b'JSON'")
        chunks.setdefault(kind, data[start:start + size])
        start += size
    if not chunks:
        raise GltfError("it has no chunk, expected b'JSON'")
    return chunks[b"JSON"], chunks.get(b"BIN\0")


def _parsed(text: bytes) -> Any:
    values = sum(text.count(mark) for mark in b",[{")
    if values > MAX_JSON_VALUES:
        raise GltfError(f"its JSON has about {values} values, expected at most {MAX_JSON_VALUES}")
    try:
        content = json.loads(text, parse_constant=_no_number)
    except (ValueError, RecursionError) as error:
        raise GltfError(f"its JSON cannot be read: {error}") from None
    if not isinstance(content, dict):
        raise GltfError(f"its JSON is a {type(content).__name__}, expected an object")
    version = content["asset"].get("version") if isinstance(content.get("asset"), dict) else None
    if not isinstance(version, str) or version.split(".")[0] != "2":
        raise GltfError(f"its asset version is {str(version)[:20]!r}, expected '2.0'")
    for name, most in MAX_ITEMS.items():
        if isinstance(items := content.get(name), list) and len(items) > most:
            raise GltfError(f"it has {len(items)} {name}, expected at most {most}")
    try:
        return built(pygltflib.GLTF2, content, "model")
    except SchemaError as error:
        raise GltfError(printable(str(error), 200)) from None


def _no_number(text: str) -> float:
    raise ValueError(f"{text} is not a number")


def item(items: Sequence[Any] | None, index: Any, kind: str, part: str) -> Any:
    """`items[index]`. Raises GltfError if the file's index is no index of theirs; `part` is what refers to it."""
    count = len(items) if items is not None else 0
    if type(index) is not int or not 0 <= index < count:
        raise GltfError(f"{part}: {kind} {shown(index)} does not exist, the model has {count}")
    assert items is not None
    return items[index]


def whole(value: Any, what: str, part: str, default: int | None = None) -> int:
    """A whole number that is not negative."""
    if value is None and default is not None:
        return default
    if type(value) is not int or value < 0:
        raise GltfError(f"{part}: {what} is {shown(value)}, expected a whole number from 0 on")
    return value


def number(value: Any, what: str, part: str, default: float, low: float = -1e9, high: float = 1e9) -> float:
    """A number in a range; one outside `low` and `high` is moved to them if finite."""
    return numbers([default if value is None else value], 1, what, part, low, high)[0]


def numbers(values: Any, count: int, what: str, part: str, low: float = -1e9, high: float = 1e9) -> list[float]:
    """So many finite numbers, clipped to a range."""
    if not isinstance(values, (list, tuple)) or len(values) != count:
        raise GltfError(f"{part}: {what} is {shown(values)}, expected {count} numbers")
    if any(type(value) not in (int, float) or not _is_finite(value) for value in values):
        raise GltfError(f"{part}: {what} is {shown(values if count > 1 else values[0])}, expected finite numbers")
    return [min(max(float(value), low), high) for value in values]


def _is_finite(value: float) -> bool:
    try:
        return math.isfinite(value)
    except OverflowError:       # an integer beyond the range of floats
        return False


def extension(item: Any, name: str, part: str) -> dict[str, Any] | None:
    """The extension's object in an item, or None."""
    extensions = item.extensions or {}
    value = extensions.get(name) if isinstance(extensions, dict) else extensions
    if value is not None and not isinstance(value, dict):
        raise GltfError(f"{part}: {name} is {shown(value)}, expected an object")
    return value


def printable(text: str, most: int = 64) -> str:
    """A stranger's text, fit for one line of a terminal or a log."""
    return "".join(c for c in text if c.isprintable())[:most]


def shown(value: Any) -> str:
    """A value as messages cite it."""
    try:
        return printable(repr(value), 80)
    except ValueError:          # a whole number of thousands of digits
        return "a very long number"

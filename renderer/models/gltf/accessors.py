"""Numbers from a model's buffers: every range is checked and every count bounded before memory is taken."""

from __future__ import annotations

import base64
import binascii
from typing import Any

import numpy as np
from numpy.typing import NDArray

from renderer.models.gltf.document import GltfError, item, shown, whole

MAX_VALUES = 48 << 20       # numbers in all accessors of a model
MAX_STRIDE = 252            # as glTF says
_COMPONENTS = {5120: np.int8, 5121: np.uint8, 5122: np.int16, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_INDEX_TYPES = (5121, 5123, 5125)


class Buffers:
    """The bytes and numbers of one document. Accessors are read once; treat what `accessor` returns as read-only."""

    def __init__(self, document: Any) -> None:
        self._document = document
        self._buffers: dict[int, bytes] = {}
        self._read: dict[int, NDArray[Any]] = {}
        self._values = 0

    def view(self, index: Any, part: str) -> tuple[memoryview, int]:
        """The bytes of a buffer view and its stride, 0 if it has none."""
        view = item(self._document.bufferViews, index, "buffer view", part)
        where = f"{part}: buffer view {index}"
        data = self._buffer(view.buffer, where)
        start, length = whole(view.byteOffset, "byteOffset", where, 0), whole(view.byteLength, "byteLength", where)
        if start + length > len(data):
            raise GltfError(f"{where} has bytes {start} to {start + length}, it ends outside its buffer of {len(data)}")
        stride = whole(view.byteStride, "byteStride", where, 0)
        if stride > MAX_STRIDE:
            raise GltfError(f"{where} has byteStride {shown(stride)}, expected at most {MAX_STRIDE}")
        return memoryview(data)[start:start + length], stride

    def _buffer(self, index: Any, part: str) -> bytes:
        buffer = item(self._document.buffers, index, "buffer", part)
        if index not in self._buffers:
            blob = self._document.binary_blob() if buffer.uri is None else data_uri(buffer.uri, f"buffer {index}")
            if blob is None or (buffer.uri is None and index != 0):
                raise GltfError(f"buffer {index} has no data")
            length = whole(buffer.byteLength, "byteLength", f"buffer {index}")
            if length > len(blob):
                raise GltfError(f"buffer {index} names {length} bytes, it has {len(blob)}")
            self._buffers[index] = blob
        return self._buffers[index]

    def count(self, index: Any, part: str) -> int:
        """How many elements an accessor says that it has."""
        return whole(item(self._document.accessors, index, "accessor", part).count, "count", f"{part}: accessor {index}")

    def accessor(self, index: Any, part: str, types: tuple[str, ...]) -> NDArray[Any]:
        """(count, width) values of an accessor of one of these types; normalised integers become floats."""
        accessor = item(self._document.accessors, index, "accessor", part)
        where = f"{part}: accessor {index}"
        if accessor.type not in types:
            raise GltfError(f"{where} is of type {shown(accessor.type)}, expected {' or '.join(types)}")
        if index not in self._read:
            self._read[index] = self._values_of(accessor, where)
        return self._read[index]

    def _values_of(self, accessor: Any, part: str) -> NDArray[Any]:
        if accessor.componentType not in _COMPONENTS:
            raise GltfError(f"{part} has component type {shown(accessor.componentType)}, expected one of "
                            f"{', '.join(map(str, _COMPONENTS))}")
        dtype, width = np.dtype(_COMPONENTS[accessor.componentType]), _WIDTHS[accessor.type]
        count = whole(accessor.count, "count", part)
        self._values += count * width
        if count < 1 or self._values > MAX_VALUES:
            raise GltfError(f"{part} has {count} elements, expected at least 1 and at most {MAX_VALUES} numbers in all accessors")
        if accessor.bufferView is None:
            values = np.zeros((count, width), dtype)
        else:
            values = self._elements(accessor.bufferView, accessor.byteOffset, count, width, dtype, part)
        if accessor.sparse is not None:
            values = self._with_sparse(values.copy(), accessor.sparse, part)
        if accessor.normalized and dtype.kind in "iu":
            return np.asarray(np.maximum(values / np.float32(np.iinfo(dtype.name).max), -1.0), dtype=np.float32)
        return values

    def _elements(self, view: Any, offset: Any, count: int, width: int, dtype: np.dtype[Any], part: str) -> NDArray[Any]:
        data, stride = self.view(view, part)
        start, size = whole(offset, "byteOffset", part, 0), dtype.itemsize * width
        stride = stride or size
        if stride < size or start + stride * (count - 1) + size > len(data):
            raise GltfError(f"{part} has {count} elements of {size} bytes every {stride}, it ends outside its buffer view of "
                            f"{len(data)} bytes")
        return np.ndarray((count, width), dtype, data, start, (stride, dtype.itemsize))

    def _with_sparse(self, values: NDArray[Any], sparse: Any, part: str) -> NDArray[Any]:
        count = whole(sparse.count, "sparse count", part)
        if not 1 <= count <= len(values) or sparse.indices.componentType not in _INDEX_TYPES:
            raise GltfError(f"{part} replaces {count} elements by indices of type {shown(sparse.indices.componentType)}, expected "
                            f"1 to {len(values)} of one of {', '.join(map(str, _INDEX_TYPES))}")
        dtype = np.dtype(_COMPONENTS[sparse.indices.componentType])
        indices = self._elements(sparse.indices.bufferView, sparse.indices.byteOffset, count, 1, dtype, f"{part} sparse indices")
        if indices.max() >= len(values):
            raise GltfError(f"{part} replaces element {indices.max()}, expected less than its {len(values)}")
        values[indices[:, 0]] = self._elements(sparse.values.bufferView, sparse.values.byteOffset, count, values.shape[1],
                                               values.dtype, f"{part} sparse values")
        return values


def data_uri(uri: Any, part: str) -> bytes:
    """The bytes embedded in a URI. Raises GltfError for one that leads outside the file."""
    head, _, body = str(uri).partition(",")
    if not head.startswith("data:") or not head.endswith(";base64"):
        raise GltfError(f"{part}: uri {shown(uri)} leads outside the file, expected embedded data")
    try:
        return base64.b64decode(body)
    except (binascii.Error, ValueError) as error:
        raise GltfError(f"{part}: uri is not base64: {error}") from None

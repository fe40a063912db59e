"""Calls of the C functions beside this file. ctypes lets go of the GIL meanwhile, so that ingest and encoder go on.

They are built with the package (`setup.py`). Without a compiler they are missing and OpenGL does their work, as on a GPU.
"""

from __future__ import annotations

import ctypes
from functools import cache, lru_cache
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from renderer.frame import YuvFrame
from renderer.light.inverse_tone_mapping import inverse_gain_table

TILE = 16                   # pixels a side, as in composite.c
LAYER_PLANES = 8            # as in composite.c
ADDED = 4                   # the first plane of what is added
# a pixel that shows a mirror, as in mirror.c
MIRRORED = np.dtype([("at", "i8"), ("u", "f4"), ("v", "f4"), ("width", "f4"), ("share", "f4", 3), ("base", "f4", 3)], align=True)
Halves = NDArray[np.float16]
Floats = NDArray[np.float32]
_Size = ctypes.c_int64
_Pointer = ctypes.c_void_p


class _Picture(ctypes.Structure):
    _fields_ = [(name, _Pointer) for name in "yuv"] + [(f"{name}_stride", _Size) for name in "yuv"] + [
        ("width", ctypes.c_int32), ("height", ctypes.c_int32)]


class _Map(ctypes.Structure):
    _fields_ = [("texels", _Pointer), ("width", _Size), ("height", _Size)]


class _Tone(ctypes.Structure):
    _fields_ = [("rgb_from_yuv", _Pointer), ("yuv_from_rgb", _Pointer), ("inverse_gain", _Pointer),
                ("inverse_gain_size", ctypes.c_int32), ("is_additive", ctypes.c_int32)]


@cache
def _library() -> ctypes.CDLL | None:
    for suffix in EXTENSION_SUFFIXES:
        path = Path(__file__).with_name(f"_kernels{suffix}")
        if path.is_file():
            library = ctypes.CDLL(str(path))
            library.mr360_keep_layers.argtypes = [_Pointer, _Pointer, _Size, _Pointer, _Pointer, _Size, _Pointer]
            library.mr360_composite.argtypes = [_Pointer, _Pointer, _Pointer, _Pointer, _Size, ctypes.c_int32]
            library.mr360_reduce.argtypes = [_Pointer, _Pointer, _Pointer, *[_Size] * 5, _Pointer, _Pointer]
            library.mr360_mirror.argtypes = [_Pointer, _Pointer, _Pointer, _Pointer, _Size, _Size, _Pointer]
            library.mr360_moments.argtypes = [_Pointer, _Pointer, _Pointer, _Size, _Size, _Pointer, _Size, _Pointer]
            return library
    return None


def is_built() -> bool:
    """Whether the functions are there."""
    return _library() is not None


def keep_layers(factors: Halves, addends: Halves, slots: NDArray[np.int32], places: NDArray[np.int32], store: Halves) -> None:
    """Copy the tiles in `slots` of two (height, width, 4) atlases to their `places` in a (n, 8, 16, 16) store."""
    for array in (factors, addends, slots, places, store):
        _check(array)
    assert factors.shape == addends.shape
    assert store.shape[1:] == (LAYER_PLANES, TILE, TILE)
    assert len(slots) == len(places)
    _loaded().mr360_keep_layers(factors.ctypes.data, addends.ctypes.data, factors.shape[1], slots.ctypes.data, places.ctypes.data,
                                len(slots), store.ctypes.data)


def composite(frame: YuvFrame, store: Halves, places: NDArray[np.int32], tiles_across: int, *, additive: bool) -> None:
    """Put the layers of the tiles in `places` of the store into a frame's planes, in place."""
    _check(store)
    _check(places)
    assert len(store) >= tiles_across * -(-frame.size[1] // TILE)
    matrices = [_single(matrix) for matrix in (frame.format.rgb_from_yuv(), frame.format.yuv_from_rgb())]
    table = inverse_gain_table()
    tone = _Tone(*(matrix.ctypes.data for matrix in matrices), table.ctypes.data, len(table), additive)
    _loaded().mr360_composite(ctypes.byref(_picture(frame)), ctypes.byref(tone), store.ctypes.data, places.ctypes.data,
                              len(places), tiles_across)


def mirror(frame: YuvFrame, radiance: Floats, pixels: NDArray[np.void], store: Halves) -> None:
    """Put what MIRRORED pixels show of a frame into the layers. `radiance`: its (height, width, 4) map, for wide looks."""
    for array in (radiance, pixels, store):
        _check(array)
    assert pixels.dtype == MIRRORED
    assert not len(pixels) or int(pixels["at"].max()) + 2 * TILE**2 < store.size
    matrix = _single(frame.format.rgb_from_yuv())
    given = _Map(radiance.ctypes.data, radiance.shape[1], radiance.shape[0])
    _loaded().mr360_mirror(ctypes.byref(_picture(frame)), ctypes.byref(given), matrix.ctypes.data, pixels.ctypes.data, len(pixels),
                           TILE**2, store.ctypes.data)


def reduce_planes(frame: YuvFrame, size: tuple[int, int], every: int = 1) -> Floats:
    """(height, width, 4) mean radiance of a frame after the tone curve, and the share of each texel that the camera has clipped.

    `size`, width and height, must divide the frame's half size. `every`: of so many rows of 2 x 2 pixels one is looked at.
    """
    width, height = size
    chroma_rows, chroma_columns = frame.u.shape
    assert chroma_columns % width == 0
    assert chroma_rows % height == 0
    matrix, weights = _single(frame.format.rgb_from_yuv()), _row_weights(chroma_rows)
    sums, texels = np.empty(4 * chroma_columns, dtype=np.float32), np.empty((height, width, 4), dtype=np.float32)
    _loaded().mr360_reduce(ctypes.byref(_picture(frame)), matrix.ctypes.data, weights.ctypes.data, width, height,
                           chroma_columns // width, chroma_rows // height, every, sums.ctypes.data, texels.ctypes.data)
    return texels


def texel_moments(frame: YuvFrame, size: tuple[int, int], texels: NDArray[np.int32]) -> Floats:
    """(n, 4) of texels, by flat index, of a map of `size`: mean luminance after the tone curve; its moments about the texel's
    centre in radians to the right, downwards, and squared."""
    _check(texels)
    matrix, weights = _single(frame.format.rgb_from_yuv()), _row_weights(frame.size[1])
    moments = np.empty((len(texels), 4), dtype=np.float32)
    _loaded().mr360_moments(ctypes.byref(_picture(frame)), matrix.ctypes.data, weights.ctypes.data, *size, texels.ctypes.data,
                            len(texels), moments.ctypes.data)
    return moments


@lru_cache(maxsize=8)
def _row_weights(rows: int) -> Floats:
    """Sine of the polar angle in the middle of each row."""
    return np.sin((np.arange(rows) + 0.5) / rows * np.pi).astype(np.float32)


def _picture(frame: YuvFrame) -> _Picture:
    planes = (frame.y, frame.u, frame.v)
    assert all(plane.strides[1] == 1 for plane in planes)
    return _Picture(*(plane.ctypes.data for plane in planes), *(plane.strides[0] for plane in planes), *frame.size)


def _single(matrix: NDArray[np.float64]) -> Floats:
    return np.ascontiguousarray(matrix, dtype=np.float32)


def _loaded() -> ctypes.CDLL:
    library = _library()
    assert library is not None, "renderer/native is not built; see is_built()"
    return library


def _check(array: NDArray[np.generic]) -> None:
    assert array.flags.c_contiguous, "expected a C-contiguous array"

"""From 10 and more bits to 8 by ordered dithering, so that smooth skies get no bands.

The thresholds belong to places in the picture: what stands still does not flicker, and an encoder predicts it from the last frame.
FFmpeg's own conversion dithers as well, but takes chroma of full range for that of limited range, up to 0.4 codes off.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

SIDE = 8               # of the matrix of thresholds
_ROWS = 4 * SIDE       # worked on at once: they stay in the cache


def dithered(codes: NDArray[np.uint16], bits: int, *, full_range: bool, is_chroma: bool, out: NDArray[np.uint8]) -> None:
    """Write (height, width) codes of 9 to 16 bits to `out` as codes of 8 bits, whose mean over any 8 x 8 pixels is theirs.

    Limited range: 8 bits are the upper ones of more. Full range: white is the largest code of both, and chroma's middle a power of
    two of both. What would lie beyond 255 is 255.
    """
    scale = 255 / (2**bits - 1) if full_range else 2.0 ** (8 - bits)
    offset = 128 - 2 ** (bits - 1) * scale if is_chroma else 0.0
    height, width = codes.shape
    thresholds = _thresholds(width) + np.float32(offset)
    values = np.empty((_ROWS, width), dtype=np.float32)
    for first in range(0, height, _ROWS):
        rows = codes[first:first + _ROWS]
        part = values[:len(rows)]
        np.multiply(rows, np.float32(scale), out=part)
        part += thresholds[:len(rows)]
        np.minimum(part, 255.0, out=part)
        out[first:first + _ROWS] = part     # none is negative: this rounds down


@lru_cache(maxsize=4)
def _thresholds(width: int) -> NDArray[np.float32]:
    """(_ROWS, width) of the 64 numbers in the middle between 64ths of 1, spread as evenly as they can be (Bayer 1973)."""
    matrix = np.zeros((1, 1))
    while len(matrix) < SIDE:
        matrix = np.block([[4 * matrix, 4 * matrix + 2], [4 * matrix + 3, 4 * matrix + 1]])
    return np.tile(((matrix + 0.5) / SIDE**2).astype(np.float32), (_ROWS // SIDE, -(-width // SIDE)))[:, :width]

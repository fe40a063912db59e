"""A time code in the picture: when it was taken, drawn as black and white blocks and read back from luma.

32 bits of a tenth of a millisecond, modulo 2^32 (five days), and 8 bits of CRC (polynomial x^8 + x^2 + x + 1), the highest bit
first, in rows of COLUMNS blocks at the picture's upper left corner. A block is a 128th of the picture's width, so that it survives
a codec's quantisation and a smaller rendition.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

COLUMNS, ROWS = 10, 4
BLOCKS_ACROSS = 128         # of the picture's width
UNIT_S = 1e-4
_BLACK, _WHITE = 16, 235
_MIDDLE, _UNSURE = 125.5, 40.0
_TIME_BITS = 32
_POLYNOMIAL = 0x07


def draw(luma: NDArray[np.uint8], seconds: float) -> None:
    """Write the code of that time (of the system's clock) into a luma plane (height, width), limited range, 512 or wider."""
    block = luma.shape[1] // BLOCKS_ACROSS
    code = round(seconds / UNIT_S) & 0xFFFFFFFF
    word = code << 8 | _checksum(code)
    bits = np.array([word >> at & 1 for at in range(COLUMNS * ROWS - 1, -1, -1)], bool).reshape(ROWS, COLUMNS)
    blocks = np.where(bits, np.uint8(_WHITE), np.uint8(_BLACK))
    luma[: ROWS * block, : COLUMNS * block] = blocks.repeat(block, axis=0).repeat(block, axis=1)


def read(luma: NDArray[np.uint8]) -> list[float]:
    """The mean luma of each block's inner half, row by row, for `decoded`. Of a picture in any size that it was scaled to."""
    block = luma.shape[1] / BLOCKS_ACROSS
    edges = [(round((at + 0.25) * block), max(round((at + 0.75) * block), round((at + 0.25) * block) + 1))
             for at in range(max(ROWS, COLUMNS))]
    return [float(luma[slice(*edges[row]), slice(*edges[column])].mean()) for row in range(ROWS) for column in range(COLUMNS)]


def decoded(blocks: Sequence[float], now: float) -> float | None:
    """Seconds of the system's clock, the nearest to `now` that the code can mean; None when the blocks are no time code."""
    if len(blocks) != COLUMNS * ROWS or any(abs(value - _MIDDLE) < _UNSURE for value in blocks):
        return None
    word = 0
    for value in blocks:
        word = word << 1 | (value > _MIDDLE)
    code, checksum = word >> 8, word & 0xFF
    if checksum != _checksum(code):
        return None
    units, turn = round(now / UNIT_S), 1 << _TIME_BITS
    return (units + (code - units + turn // 2) % turn - turn // 2) * UNIT_S


def _checksum(code: int) -> int:
    remainder = 0
    for byte in code.to_bytes(_TIME_BITS // 8, "big"):
        remainder ^= byte
        for _ in range(8):
            remainder = (remainder << 1 ^ (_POLYNOMIAL if remainder & 0x80 else 0)) & 0xFF
    return remainder

"""Transfer functions and Y'CbCr matrices.

The display signal is sRGB-encoded (cameras' BT.709 video is shown with that curve by every browser); 8-bit Y'CbCr is
turned into it by the matrix and range of the stream's tags.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Matrix = Literal["bt601", "bt709"]
LUMA_WEIGHTS: dict[str, tuple[float, float]] = {"bt601": (0.299, 0.114), "bt709": (0.2126, 0.0722)}  # Kr, Kb


def linear_from_srgb(signal: NDArray[np.floating]) -> NDArray[np.float64]:
    """IEC 61966-2-1 decoding; negative input is mirrored so that the function stays odd."""
    s = np.abs(np.asarray(signal, dtype=np.float64))
    return np.asarray(np.copysign(np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4), signal))


def srgb_from_linear(linear: NDArray[np.floating]) -> NDArray[np.float64]:
    """IEC 61966-2-1 encoding, the inverse of `linear_from_srgb`."""
    v = np.abs(np.asarray(linear, dtype=np.float64))
    return np.asarray(np.copysign(np.where(v <= 0.0031308, v * 12.92, 1.055 * v ** (1 / 2.4) - 0.055), linear))


@dataclass(frozen=True)
class YuvFormat:
    """How 8-bit Y'CbCr codes mean R'G'B'."""

    matrix: Matrix = "bt709"
    full_range: bool = False

    def rgb_from_yuv(self) -> NDArray[np.float64]:
        """(3, 4) matrix from (Y, U, V, 1), each code / 255, to R'G'B' in [0, 1]."""
        kr, kb = LUMA_WEIGHTS[self.matrix]
        kg = 1.0 - kr - kb
        to_rgb = np.array([
            [1.0, 0.0, 2 * (1 - kr)],
            [1.0, -2 * kb * (1 - kb) / kg, -2 * kr * (1 - kr) / kg],
            [1.0, 2 * (1 - kb), 0.0],
        ])
        luma_scale, chroma_scale = (1.0, 1.0) if self.full_range else (255 / 219, 255 / 224)
        scaled = to_rgb * np.array([luma_scale, chroma_scale, chroma_scale])
        black = np.array([0.0 if self.full_range else 16 / 255, 128 / 255, 128 / 255])
        return np.concatenate([scaled, -(scaled @ black)[:, None]], axis=1)

    def yuv_from_rgb(self) -> NDArray[np.float64]:
        """(3, 4) matrix from (R', G', B', 1) to codes / 255, the inverse of `rgb_from_yuv`."""
        forward = self.rgb_from_yuv()
        inverse = np.linalg.inv(forward[:, :3])
        return np.concatenate([inverse, -(inverse @ forward[:, 3])[:, None]], axis=1)

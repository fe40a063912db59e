"""The three kinds of frame that enter the renderer. Arrays are owned by the caller, who may reuse them after `render`."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from renderer.color import YuvFormat

MIN_SIZE = 2
MAX_SIZE = 16384


@dataclass(frozen=True)
class YuvFrame:
    """8-bit Y'CbCr 4:2:0. `y` is (height, width), `u` and `v` are (height / 2, width / 2); both sizes are even."""

    y: NDArray[np.uint8]
    u: NDArray[np.uint8]
    v: NDArray[np.uint8]
    format: YuvFormat = field(default_factory=YuvFormat)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.y.shape[1], self.y.shape[0]

    def copy(self) -> YuvFrame:
        return YuvFrame(self.y.copy(), self.u.copy(), self.v.copy(), self.format)


@dataclass(frozen=True)
class RgbFrame:
    """8-bit display signal, (height, width, 3) uint8."""

    rgb: NDArray[np.uint8]

    @property
    def size(self) -> tuple[int, int]:
        return self.rgb.shape[1], self.rgb.shape[0]


@dataclass(frozen=True)
class RadianceFrame:
    """Linear radiance, (height, width, 3) float32. No inverse tone mapping applies."""

    rgb: NDArray[np.float32]

    @property
    def size(self) -> tuple[int, int]:
        return self.rgb.shape[1], self.rgb.shape[0]


Frame = YuvFrame | RgbFrame | RadianceFrame


def check_size(frame: Frame) -> None:
    """Raises ValueError when the frame is too small or too large, or a Y'CbCr frame's sizes are odd or inconsistent."""
    width, height = frame.size
    if not (MIN_SIZE <= width <= MAX_SIZE and MIN_SIZE <= height <= MAX_SIZE):
        raise ValueError(f"frame is {width}x{height}, expected {MIN_SIZE} to {MAX_SIZE} pixels on each side")
    if isinstance(frame, YuvFrame):
        half = (height // 2, width // 2)
        if width % 2 or height % 2 or frame.u.shape != half or frame.v.shape != half:
            raise ValueError(f"planes are {frame.y.shape}, {frame.u.shape}, {frame.v.shape}, expected even luma sizes "
                             f"and chroma of half of them")

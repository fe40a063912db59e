"""What the synthetic camera's clip looks like where nothing moves, to compare a received picture with."""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

RGB_FROM_YUV = np.array([[1.164384, 0.0, 1.792741], [1.164384, -0.213249, -0.532909], [1.164384, 2.112402, 0.0]])


class SourcePicture:
    """Mean display-coded RGB of frames across the loop, and a mask of pixels that neither sun nor shadow touches."""

    def __init__(self, clip: Path) -> None:
        with av.open(str(clip)) as container:
            frames = [rgb_from_frame(frame) for frame in itertools.islice(container.decode(video=0), 0, None, 45)]
        stack = np.stack(frames)
        self.mean = stack.mean(0)
        self.still = (stack.max(0) - stack.min(0)).max(-1) < 12

    def psnr_db(self, pixels: NDArray[np.uint8], region: NDArray[np.bool_]) -> float:
        """Peak signal to noise of `pixels` against the source where `region` and the still mask are both true."""
        where = region & self.still
        assert where.mean() > 0.05, "too little of the picture is still"
        error = pixels[where].astype(float) - self.mean[where]
        return 10 * math.log10(255**2 / float((error**2).mean()))

    def bias(self, pixels: NDArray[np.uint8], region: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Mean difference of each channel in codes: what a wrong matrix or range would show."""
        where = region & self.still
        difference: NDArray[np.float64] = (pixels[where].astype(float) - self.mean[where]).mean(0)
        return difference


def rgb_from_frame(frame: av.VideoFrame) -> NDArray[np.float64]:
    """BT.709 limited-range 4:2:0 to display-coded RGB (height, width, 3) in 0..255, chroma repeated."""
    planes = frame.to_ndarray(format="yuv420p")
    height, width = frame.height, frame.width
    luma = planes[:height].astype(float) - 16
    chroma = planes[height:].reshape(2, height // 2, width // 2).repeat(2, 1).repeat(2, 2).astype(float) - 128
    yuv = np.stack([luma, chroma[0], chroma[1]], -1)
    rgb: NDArray[np.float64] = np.clip(yuv @ RGB_FROM_YUV.T, 0, 255)
    return rgb


def pixel_of(position: tuple[float, float, float], shape: tuple[int, ...]) -> tuple[int, int]:
    """Row and column at which a point in the world is seen."""
    x, y, z = position
    u = 0.5 + math.atan2(x, -z) / (2 * math.pi)
    v = math.acos(y / math.hypot(x, y, z)) / math.pi
    return int(v * shape[0]), int(u * shape[1])

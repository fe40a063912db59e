"""A panorama whose colour is known in every direction: 12 sectors of 30° by 4 bands of 45°, each its own."""

from __future__ import annotations

import colorsys
import math

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw

SECTORS = 12
BANDS = 4
_SATURATION = (0.45, 1.0, 1.0, 0.55)
_VALUE = (1.0, 0.95, 0.55, 0.35)
_MARGIN = 0.2   # of a cell: numbers, chroma subsampling and interpolation stay outside the middle


def cell_color(sector: int, band: int) -> tuple[int, int, int]:
    """Display-coded 8-bit RGB of a cell; sector 0 begins at u = 0, band 0 is the top."""
    red, green, blue = colorsys.hsv_to_rgb(sector / SECTORS, _SATURATION[band], _VALUE[band])
    return round(red * 255), round(green * 255), round(blue * 255)


def uv_from_direction(direction: tuple[float, float, float]) -> tuple[float, float]:
    """Panorama coordinates in [0, 1] of a direction of any length but zero (DESIGN 1.1)."""
    x, y, z = direction
    return 0.5 + math.atan2(x, -z) / math.tau, math.atan2(math.hypot(x, z), y) / math.pi


def color_at(direction: tuple[float, float, float]) -> tuple[int, int, int] | None:
    """8-bit RGB seen in a direction, or None near the edge of a cell, where a picture may honestly differ."""
    u, v = uv_from_direction(direction)
    across, down = (u % 1.0) * SECTORS, min(v, 1 - 1e-9) * BANDS
    if not all(_MARGIN < position % 1.0 < 1 - _MARGIN for position in (across, down)):
        return None
    return cell_color(int(across), int(down))


def picture(width: int = 2048) -> npt.NDArray[np.uint8]:
    """The panorama, (width / 2, width, 3) RGB, with the number of each cell in its corner for human eyes."""
    image = Image.new("RGB", (width, width // 2))
    draw = ImageDraw.Draw(image)
    across, down = width / SECTORS, width / 2 / BANDS
    for band in range(BANDS):
        for sector in range(SECTORS):
            left, top = sector * across, band * down
            draw.rectangle((left, top, left + across, top + down), fill=cell_color(sector, band))
            draw.text((left + across * 0.03, top + down * 0.03), f"{sector}.{band}", fill="black")
    return np.asarray(image)

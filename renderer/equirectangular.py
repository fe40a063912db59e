"""Directions and the equirectangular frame, each the inverse of the other.

`u = 0.5 + atan2(x, -z) / 2pi`, `v = acos(y) / pi`; +Y up, -Z forward; row 0 is up; `u = 0.5` is forward.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def uv_from_direction(direction: NDArray[np.floating]) -> Array:
    """(..., 3) directions of any length to (..., 2) u, v in [0, 1]."""
    d = np.asarray(direction, dtype=np.float64)
    x, y, z = d[..., 0], d[..., 1], d[..., 2]
    u = 0.5 + np.arctan2(x, -z) / (2 * np.pi)
    v = np.arctan2(np.hypot(x, z), y) / np.pi  # acos(y), without its loss of precision near the poles
    return np.stack([u, v], axis=-1)


def direction_from_uv(uv: NDArray[np.floating]) -> Array:
    """(..., 2) u, v to (..., 3) unit directions."""
    uv = np.asarray(uv, dtype=np.float64)
    azimuth = (uv[..., 0] - 0.5) * (2 * np.pi)
    polar = uv[..., 1] * np.pi
    sin_polar = np.sin(polar)
    return np.stack([sin_polar * np.sin(azimuth), np.cos(polar), -sin_polar * np.cos(azimuth)], axis=-1)


@lru_cache(maxsize=16)
def pixel_directions(height: int, width: int) -> Array:
    """(height, width, 3) unit directions of the pixel centres. Cached and read-only."""
    u = (np.arange(width) + 0.5) / width
    v = (np.arange(height) + 0.5) / height
    directions = direction_from_uv(np.stack(np.broadcast_arrays(u[None, :], v[:, None]), axis=-1))
    directions.setflags(write=False)
    return directions


@lru_cache(maxsize=16)
def solid_angles(height: int, width: int) -> Array:
    """(height, 1) exact solid angle in sr of one pixel of each row; times `width`, they sum to 4 pi. Read-only."""
    edges = np.cos(np.linspace(0.0, np.pi, height + 1))
    angles = ((edges[:-1] - edges[1:]) * (2 * np.pi / width))[:, None]
    angles.setflags(write=False)
    return angles

"""The projection in which silhouettes are drawn: that of a view, finer, and turned a little.

Turned, because the samples of an upright grid stand in columns: an upright edge then covers a whole column of them or none. At a
slope of one in two each of 2 x 2 samples has a column and a row of its own; they are averaged to a texel of the second level.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from renderer.objects.placement import View

Array = NDArray[np.float64]
SAMPLES = 8               # a side of a panorama pixel; half as many texels of the second level
MAX_FINER = 2.0           # towards the poles, where the panorama's pixels are narrower
MAX_SIZE = 4096
_SLOPE = np.arctan(1 / 2)
_TURN = np.array([[np.cos(_SLOPE), np.sin(_SLOPE)], [-np.sin(_SLOPE), np.cos(_SLOPE)]])


@dataclass(frozen=True)
class SilhouetteView:
    """`size` in samples; `uv_from_tangent` (2, 3) takes a view's tangent plane (x, y, 1) to 0..1."""

    size: tuple[int, int]
    clip_from_world: Array
    uv_from_tangent: Array


def silhouette_view(view: View) -> SilhouetteView:
    """The one that covers all of a view."""
    left, right, bottom, top = view.bounds
    corners = np.array([[x, y] for x in (left, right) for y in (bottom, top)]) @ _TURN.T
    low, extent = corners.min(axis=0), np.ptp(corners, axis=0)
    width, height = (view.size[0] / (right - left), view.size[1] / (top - bottom))      # samples a unit
    horizontal = float(np.hypot(view.rotation[2, 0], view.rotation[2, 2]))
    finer = SAMPLES / view.density * min(1 / max(horizontal, 1e-3), MAX_FINER)
    size = tuple(int(min(np.ceil(length * density * finer), MAX_SIZE))
                 for length, density in zip(extent, (width, height), strict=True))
    uv = np.concatenate([_TURN, -low[:, None]], axis=1) / extent[:, None]
    clip = view.clip_from_world()
    x, y, depth = view.rotation[0], view.rotation[1], view.rotation[2]
    for row in (0, 1):
        direction = uv[row, 0] * x + uv[row, 1] * y + uv[row, 2] * depth
        clip[row] = (*(2 * direction - depth), 0.0)
    return SilhouetteView((size[0], size[1]), clip, uv)

"""The middle of an aureole: the direction around which a clear sky falls off most evenly.

ln L = a + b ln(angle + offset) + c / (height + offset), where the angle is that to the sun; a, b and c follow from the direction
(variable projection), so that only its two angles are searched, by Gauss-Newton steps in a narrower and narrower part of the sky.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from renderer.equirectangular import pixel_directions, solid_angles
from renderer.light.inverse_tone_mapping import approximate_linear_from_radiance
from renderer.light.radiance_map import RadianceMap

Array = NDArray[np.float64]
Floats = NDArray[np.floating]
COARSE_WIDTHS = np.radians((50, 40, 32))        # of the sky that is fitted, step by step, from scratch
FINE_WIDTH, FINE_STEPS = np.radians(26), 3      # and then, or from the last frame's direction, on the whole map
MAX_VARIANCE = 0.015            # of ln radiance that the fit may leave: more, and the horizon or clouds have a part in it
ANGLE_OFFSET, HORIZON_OFFSET = 0.02, 0.15
MAX_TURN = 0.1
MIN_TEXELS = 60
HORIZON = 0.05                  # height of a direction; below it nothing is sky


def fitted_sun(radiance_map: RadianceMap, coarse: SkySamples, centre: Array, last: Array | None) -> Array | None:
    """The direction around which the sky falls off most evenly, step by step in a narrower part of it; None if it does not."""
    sun = centre if last is None else last
    for width in COARSE_WIDTHS if last is None else ():
        sun = coarse.turned(sun, width)[0]
    if coarse.turned(sun, COARSE_WIDTHS[0])[1] > MAX_VARIANCE:
        return None
    height, width = radiance_map.clipped.shape
    directions = pixel_directions(height, width).reshape(-1, 3)
    near = np.flatnonzero(directions @ sun > np.cos(FINE_WIDTH + MAX_TURN))
    fine = SkySamples(approximate_linear_from_radiance(radiance_map.rgb.reshape(-1, 3)[near]), radiance_map.clipped.ravel()[near],
                       directions[near], np.asarray(solid_angles(height, width)[near // width, 0], dtype=np.float64))
    for _ in range(FINE_STEPS):
        sun = fine.turned(sun, FINE_WIDTH)[0]
    return sun


class SkySamples:
    """Texels of a clear sky: their directions, ln of the least channel, which is the last to clip, and what weighs them."""

    def __init__(self, rgb: Floats, clipped: Floats, directions: Array, angles: Array) -> None:
        lowest = np.minimum(np.minimum(rgb[:, 0], rgb[:, 1]), rgb[:, 2])
        usable = (clipped < 1e-3) & (directions[:, 1] > HORIZON) & (lowest > 1e-3)
        self._directions, self._weights = directions[usable], angles[usable]
        self._values = np.log(lowest[usable])
        self._heights = 1 / (self._directions[:, 1] + HORIZON_OFFSET)

    def turned(self, sun: Array, width: float) -> tuple[Array, float]:
        """One Gauss-Newton step of the direction for ln L = a + b ln(angle + offset) + c / (height + offset), over the texels
        within that angle; a, b and c follow. And the variance that was left unexplained before it; infinite with too few texels."""
        cosine = self._directions @ sun
        near = cosine > np.cos(width)
        if np.count_nonzero(near) < MIN_TEXELS:
            return sun, np.inf
        directions, angle = self._directions[near], np.arccos(np.minimum(cosine[near], 1.0))
        tangents = _tangents(sun)
        slopes = -(directions @ tangents.T) / (np.maximum(np.sin(angle), 1e-3) * (angle + ANGLE_OFFSET))[:, None]
        columns = np.column_stack([np.ones_like(angle), np.log(angle + ANGLE_OFFSET), self._heights[near], slopes,
                                   self._values[near]])
        products = columns.T @ (columns * self._weights[near][:, None])
        # what a, b and c explain is taken out of the rest (the Schur complement of their normal equations)
        explained = np.linalg.solve(products[:3, :3] + 1e-12 * np.eye(3), products[:3, 3:])
        left = products[3:, 3:] - products[3:, :3] @ explained
        falloff = explained[1, 2]
        normal = falloff**2 * left[:2, :2]
        turn = np.linalg.solve(normal + 1e-9 * max(float(np.trace(normal)), 1e-12) * np.eye(2), falloff * left[:2, 2])
        turn *= min(1.0, MAX_TURN / max(float(np.linalg.norm(turn)), 1e-12))
        moved = sun + turn @ tangents
        return np.asarray(moved / np.linalg.norm(moved)), float(left[2, 2] / self._weights[near].sum())


def _tangents(direction: Array) -> Array:
    first = np.cross(direction, (0.0, 1.0, 0.0) if abs(direction[1]) < 0.9 else (1.0, 0.0, 0.0))
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(direction, first)])

"""Light that the camera has clipped: how much brighter it was than white, estimated from what the frame still shows.

The papers' operator ends at 11.8, whatever was there, and MR360 (section 4.1) raises lights "of smaller solid angles" by an
ad-hoc mapping. Ours has a reason for each region:
- a glow goes on as it grew. The share of the sphere that is brighter than t falls as a power of t; carried on beyond white,
  its mean is a / (a - 1) times white (Pareto), with the exponent a from the share above half white and above white;
- a small region above the horizon is a lamp: up to 20 times white, less the larger it is; where nothing larger is clipped it is
  what lights the scene, all of them together with up to one and a half times the light of the frame. A glint of a few pixels is
  neither.
A sun in a clear sky is found by `sun.py`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from renderer.equirectangular import pixel_directions, solid_angles
from renderer.light.inverse_tone_mapping import OFFSET, SLOPE
from renderer.light.radiance_map import RadianceMap
from renderer.light.sources import label_components

Array = NDArray[np.float64]
Floats = NDArray[np.floating]
PEAK = SLOPE + OFFSET           # radiance of white by the papers' operator; OFFSET times what it is without the tenth power
HALF_WHITE, WHITE = 0.5, 0.95   # linear luminance
MAX_GLOW = 4.0                  # times white
MAX_LAMP, LAMP_SR = 20.0, 0.05  # times white, for regions well below that solid angle
GLINT_SR = 3e-4
POWER_SR, MAX_POWER = 0.01, 1.5     # of all lamps together, in units of the frame's mean irradiance
BESIDE_LARGE = 0.05              # where a sky or a window is clipped too, what is small is not what lights the scene
MAX_GAIN = 300.0
SMOOTHING_S = 3.0


class HighlightRestorer:
    """Restores one frame after another; the glow is smoothed over time, for noise moves regions in and out of white."""

    def __init__(self) -> None:
        self._glow: float | None = None

    def reset(self) -> None:
        self._glow = None

    def restore(self, radiance_map: RadianceMap, step_s: float, clear: float = 0.0, gain: float | None = None) -> RadianceMap:
        """The map with its clipped shares at their estimated radiance, and the factor by texel. Under a `clear` sky (0 to 1) there
        are no lamps. `gain`, of what the operator gives, stands in for the estimate."""
        texels = np.flatnonzero(radiance_map.clipped)
        if not len(texels):
            return radiance_map
        luminance = radiance_map.luminance
        if gain is None:
            glow = self._smoothed(glow_gain(luminance), step_s)
            factor = np.maximum(glow * (OFFSET / PEAK), (1.0 - clear) * _lamp_factors(luminance, radiance_map.clipped, texels))
        else:
            factor = np.full(len(texels), gain)
        # of a texel that is clipped in part, that part is raised
        share = np.minimum(radiance_map.clipped.ravel()[texels] * PEAK / np.maximum(luminance.ravel()[texels], 1e-9), 1.0)
        rgb, raised = radiance_map.rgb.copy(), np.ones_like(luminance)
        raised.ravel()[texels] = 1.0 + share * (factor - 1.0)
        rgb.reshape(-1, 3)[texels] *= raised.ravel()[texels, None]
        return RadianceMap(rgb, radiance_map.clipped, raised)

    def _smoothed(self, glow: float, step_s: float) -> float:
        rate = 1.0 if self._glow is None else 1.0 - np.exp(-step_s / SMOOTHING_S)
        self._glow = float(np.exp((1 - rate) * np.log(self._glow or 1.0) + rate * np.log(glow)))
        return self._glow


def glow_gain(luminance: Floats) -> float:
    """Mean of clipped radiance in units of white, 1 to MAX_GLOW, by how the share of the sphere above a level falls."""
    weights = solid_angles(*luminance.shape)[:, 0]
    half, white = (float(weights @ np.count_nonzero(luminance > level * (SLOPE * level**10 + OFFSET), axis=1))
                   for level in (HALF_WHITE, WHITE))
    exponent = np.log(max(half, 1e-9) / max(white, 1e-9)) / np.log(WHITE / HALF_WHITE)
    return float(np.clip(exponent / max(exponent - 1.0, 1e-3), 1.0, MAX_GLOW)) if exponent > 0 else MAX_GLOW


def _lamp_factors(luminance: Floats, clipped: Floats, texels: NDArray[np.intp]) -> Array:
    """For these clipped texels the factors on the operator's white: of small regions above the horizon, 0 for others."""
    labels, count = label_components(clipped > 0.0)
    names, rows = labels.ravel()[texels], texels // labels.shape[1]
    angles, height = solid_angles(*labels.shape)[:, 0], pixel_directions(*labels.shape)[:, 0, 1]
    area = clipped.ravel()[texels] * angles[rows]
    solid_angle = np.maximum(np.bincount(names, area, count + 1), 1e-12)
    above = np.bincount(names, area * height[rows], count + 1) > 0.0
    seen = solid_angle / (solid_angle + GLINT_SR)
    lamp = MAX_LAMP / (1 + (solid_angle / LAMP_SR) ** 2) * seen
    wanted = np.where(above, MAX_POWER / (1 + solid_angle / POWER_SR) * seen**2, 0.0)
    # a quarter of 4 pi times the mean radiance, white as white
    mean = float(angles @ luminance.sum(axis=1, dtype=np.float64) - (PEAK - OFFSET) * area.sum()) / 4
    power = _alone(solid_angle[1:]) * wanted**2 / max(float(wanted.sum()), 1e-12) * mean / (PEAK * solid_angle)
    factors = np.where(above, np.minimum(np.maximum(lamp * (OFFSET / PEAK), power), MAX_GAIN), 0.0)
    return np.asarray(factors[names])


def _alone(solid_angles_sr: Array) -> float:
    """1 if nothing but small regions is clipped; less, the more else is."""
    small = float(solid_angles_sr[solid_angles_sr < LAMP_SR].sum())
    return small / max(small + BESIDE_LARGE * (float(solid_angles_sr.sum()) - small), 1e-12)

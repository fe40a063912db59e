"""Radiance maps with known lights."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from renderer.equirectangular import pixel_directions, solid_angles
from renderer.light.detection import Detection, find_candidates
from renderer.light.radiance_map import RadianceMap
from renderer.light.tracking import LightTracker
from tests.renderer.frames import direction

HEIGHT, WIDTH = 128, 256
__all__ = ["HEIGHT", "WIDTH", "detect", "direction", "disc", "radiance_map"]


def detect(given: RadianceMap) -> Detection:
    """Lights and residual of a map, as of a first frame."""
    return LightTracker().update(find_candidates(given))


def radiance_map(radiance: np.ndarray) -> RadianceMap:
    """A grey map, (height, width), of which nothing is clipped."""
    return RadianceMap(np.broadcast_to(radiance[..., None], (*radiance.shape, 3)).astype(np.float64), np.zeros(radiance.shape))


def disc(azimuth: float, elevation: float, radius: float, value: float = 200.0, sky: float = 0.3) -> RadianceMap:
    """A disc with area-true edges, of exactly its solid angle: each texel by 8 x 8 samples. Angles in degrees."""
    return radiance_map(sky + (value - sky) * _coverage(azimuth, elevation, radius))


@lru_cache(maxsize=256)
def _coverage(azimuth: float, elevation: float, radius: float) -> np.ndarray:
    fine = pixel_directions(HEIGHT * 8, WIDTH * 8) @ direction(azimuth, elevation) > np.cos(np.radians(radius))
    weights = fine * solid_angles(HEIGHT * 8, WIDTH * 8)
    covered = weights.reshape(HEIGHT, 8, WIDTH, 8).sum(axis=(1, 3)) * (2 * np.pi * (1 - np.cos(np.radians(radius))) / weights.sum())
    return np.asarray(covered / solid_angles(HEIGHT, WIDTH))

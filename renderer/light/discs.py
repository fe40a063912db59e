"""Lights as discs of the sky: directions over one, and when a light is still where it was."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from renderer.light.detection import Light

Array = NDArray[np.float64]
STALE_SHARE = 0.25         # of a light's angular radius: how far it may move before its shadows are drawn anew
STALE_MIN = np.radians(0.05)


def disc_directions(direction: Array, angular_radius: float, count: int) -> Array:
    """(count, 3) unit directions spread evenly over a disc of the sky (Fibonacci spiral)."""
    x, y, z = direction
    # an orthonormal basis without a branch that could fail (Duff et al. 2017)
    sign = 1.0 if z >= 0 else -1.0
    a = -1.0 / (sign + z)
    b = x * y * a
    right, up = np.array([1 + sign * x * x * a, sign * b, -sign * x]), np.array([b, sign + y * y * a, -y])
    index = np.arange(count)
    cosine = 1 - (index + 0.5) / count * (1 - np.cos(angular_radius))
    sine = np.sqrt(np.maximum(1 - cosine**2, 0.0))
    phi = index * np.pi * (3 - np.sqrt(5))
    return np.asarray(cosine[:, None] * direction + (sine * np.cos(phi))[:, None] * right + (sine * np.sin(phi))[:, None] * up)


def hardly_moved(before: Light, now: Light, tolerance: float = STALE_SHARE, least: float = STALE_MIN) -> bool:
    """By less than this share of its radius or `least` radians, and without growing much."""
    moved = float(np.arccos(np.clip(before.direction @ now.direction, -1, 1)))
    grown = abs(before.angular_radius - now.angular_radius)
    return moved <= max(tolerance * now.angular_radius, least) and grown <= 0.2 * now.angular_radius


def share_below_horizon(light: Light) -> float:
    """Of a light's disc: a segment of a circle."""
    height = float(np.clip(light.direction[1] / max(np.sin(light.angular_radius), 1e-9), -1, 1))
    return float((np.arccos(height) - height * np.sqrt(1 - height * height)) / np.pi)

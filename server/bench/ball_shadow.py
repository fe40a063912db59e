"""What a ball hides of a disc light and of a sky from points of the ground, exactly: the reference of the shadow stage."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from renderer.light.detection import Light

Array = NDArray[np.float64]
UP = np.array([0.0, 1.0, 0.0])
NODES = 256


def hidden_share(points: Array, centre: Array, radius: float, light: Light) -> Array:
    """(n,) share of a light's irradiance on the ground that a ball hides, for (n, 3) points outside it.

    From a point the ball is a cap of half-angle b; around each ring of the disc it hides an arc whose cosine-weighted length has a
    closed form. Over the rings by Gauss-Legendre quadrature in the square of the sine. Exact for discs wholly above the horizon.
    """
    towards = centre - points
    distance = np.linalg.norm(towards, axis=1)
    towards = towards / distance[:, None]
    cap = np.arcsin(np.minimum(radius / distance, 1.0))
    cosine = np.clip(towards @ light.direction, -1, 1)
    sine = np.sqrt(1 - cosine**2)
    nodes, weights = quadrature(NODES)
    ring_sine = np.sqrt((nodes + 1) / 2) * np.sin(light.angular_radius)
    ring_cosine = np.sqrt(1 - ring_sine**2)
    # hidden where ring_cosine cosine + ring_sine sine cos(phi) > cos(cap), phi from the ball's side of the ring
    missing = np.cos(cap)[:, None] - cosine[:, None] * ring_cosine
    edge = np.arccos(np.clip(missing / np.maximum(sine[:, None] * ring_sine, 1e-300), -1, 1))
    across = towards - cosine[:, None] * light.direction
    tilt = (across @ UP) / np.maximum(np.linalg.norm(across, axis=1), 1e-300)
    height = float(light.direction[1])
    arc = height * ring_cosine * edge + (tilt[:, None] * ring_sine) * np.sin(edge)
    return np.asarray((arc / (np.pi * ring_cosine)) @ weights / 2 / height)


@lru_cache(maxsize=4)
def quadrature(count: int) -> tuple[Array, Array]:
    """Nodes in [-1, 1] and weights of Gauss and Legendre."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return nodes, weights


def hidden_sky(points: Array, centre: Array, radius: float) -> Array:
    """(n,) share of a uniform sky's irradiance on the ground that a ball above it hides: (n . d) (r / d)^2."""
    towards = centre - points
    distance = np.linalg.norm(towards, axis=1)
    return np.asarray(towards[:, 1] / distance * (radius / distance) ** 2)

"""Light that an object gives back to the ground next to it, as radiance by direction seen from there."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from renderer.light.detection import Light
from renderer.light.irradiance import basis, disc_cosine
from renderer.objects.near_field import Body, Fit, texels

Array = NDArray[np.floating]
DIRECTIONS = 64
UPRIGHT = 0.3      # of a direction's climb: how much of it the surfaces that are met there lean towards the ground
BASE = 0.5         # of the object's radius: how far below its middle the light comes from that matters most


@lru_cache(maxsize=1)
def _upper_directions() -> tuple[Array, Array]:
    """(n, 3) directions of the upper hemisphere, and (9, n) what turns values along them into harmonics."""
    index = np.arange(DIRECTIONS)
    y, phi = (index + 0.5) / DIRECTIONS, index * np.pi * (3 - np.sqrt(5))
    s = np.sqrt(1 - y * y)
    directions = np.stack([s * np.cos(phi), y, s * np.sin(phi)], axis=1)
    return directions, np.asarray(np.linalg.pinv(basis(directions)[:, :9], rcond=1e-2), dtype=np.float64)


def bounced(body: Body, fit: Fit, irradiance: NDArray[np.float32], lights: tuple[Light, ...], ground_y: float) -> Array:
    """(9, 3) coefficients of the radiance that the ground sees where the object is: of its sides that face the ground, as they are
    lit by the (rows, 2 * rows, 3) irradiance map without `lights`, near field included, and by the lights."""
    directions, solver = _upper_directions()
    normals = -directions * [1.0, UPRIGHT, 1.0]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    received = irradiance.reshape(-1, 3)[texels(normals, irradiance.shape[0])].astype(np.float64)
    places = body.solid.centre + normals * body.solid.radius - [0.0, BASE * body.solid.radius, 0.0]
    received *= fit.ratio(places, normals, ground_y)
    for light in lights:
        received += light.irradiance * disc_cosine(normals @ light.direction, light.angular_radius)[:, None]
    return np.asarray(solver @ (body.albedo * received / np.pi))

"""Diffuse light: real spherical harmonics of the radiance map up to order 4, and irradiance from them.

E_lm = A_l L_lm with A = pi, 2 pi / 3, pi / 4, 0, -pi / 24 (Ramamoorthi & Hanrahan 2001). Order 3 carries no irradiance.
Basis order and signs are those of WebXR's XRLightEstimate and three.js: 1, y, z, x, xy, yz, 3z^2 - 1, xz, x^2 - y^2, ...
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from renderer.equirectangular import pixel_directions, solid_angles

Array = NDArray[np.float64]
ORDER = 4
COEFFICIENTS = (ORDER + 1) ** 2
BAND = np.array([band for band in range(ORDER + 1) for _ in range(2 * band + 1)])
COSINE_LOBE = np.array([np.pi, 2 * np.pi / 3, np.pi / 4, 0.0, -np.pi / 24])[BAND]


def basis(direction: NDArray[np.floating]) -> Array:
    """(..., 3) unit directions to (..., 25) real spherical harmonics, orthonormal over the sphere."""
    d = np.asarray(direction, dtype=np.float64)
    x, y, z = d[..., 0], d[..., 1], d[..., 2]
    x2, y2, z2 = x * x, y * y, z * z
    one = np.ones_like(x)
    pi = np.pi
    return np.stack([
        0.5 * np.sqrt(1 / pi) * one,
        np.sqrt(3 / (4 * pi)) * y, np.sqrt(3 / (4 * pi)) * z, np.sqrt(3 / (4 * pi)) * x,
        0.5 * np.sqrt(15 / pi) * x * y, 0.5 * np.sqrt(15 / pi) * y * z, 0.25 * np.sqrt(5 / pi) * (3 * z2 - 1),
        0.5 * np.sqrt(15 / pi) * x * z, 0.25 * np.sqrt(15 / pi) * (x2 - y2),
        0.25 * np.sqrt(35 / (2 * pi)) * y * (3 * x2 - y2), 0.5 * np.sqrt(105 / pi) * x * y * z,
        0.25 * np.sqrt(21 / (2 * pi)) * y * (5 * z2 - 1), 0.25 * np.sqrt(7 / pi) * z * (5 * z2 - 3),
        0.25 * np.sqrt(21 / (2 * pi)) * x * (5 * z2 - 1), 0.25 * np.sqrt(105 / pi) * z * (x2 - y2),
        0.25 * np.sqrt(35 / (2 * pi)) * x * (x2 - 3 * y2),
        0.75 * np.sqrt(35 / pi) * x * y * (x2 - y2), 0.75 * np.sqrt(35 / (2 * pi)) * y * z * (3 * x2 - y2),
        0.75 * np.sqrt(5 / pi) * x * y * (7 * z2 - 1), 0.75 * np.sqrt(5 / (2 * pi)) * y * z * (7 * z2 - 3),
        3 / 16 * np.sqrt(1 / pi) * (35 * z2 * z2 - 30 * z2 + 3), 0.75 * np.sqrt(5 / (2 * pi)) * x * z * (7 * z2 - 3),
        3 / 8 * np.sqrt(5 / pi) * (x2 - y2) * (7 * z2 - 1), 0.75 * np.sqrt(35 / (2 * pi)) * x * z * (x2 - 3 * y2),
        3 / 16 * np.sqrt(35 / pi) * (x2 * (x2 - 3 * y2) - y2 * (3 * x2 - y2)),
    ], axis=-1)


@lru_cache(maxsize=8)
def _projection(height: int, width: int) -> NDArray[np.float32]:
    weighted = basis(pixel_directions(height, width)) * solid_angles(height, width)[..., None]
    matrix = np.ascontiguousarray(weighted.reshape(-1, COEFFICIENTS).T, dtype=np.float32)  # half the memory to read
    matrix.setflags(write=False)
    return matrix


def project(radiance: NDArray[np.floating]) -> Array:
    """(height, width, 3) radiance map to (25, 3) coefficients L_lm of its radiance."""
    height, width = radiance.shape[:2]
    return (_projection(height, width) @ np.asarray(radiance, dtype=np.float32).reshape(-1, 3)).astype(np.float64)


def irradiance(coefficients: NDArray[np.floating], normal: NDArray[np.floating]) -> Array:
    """Irradiance (..., 3) on (..., 3) unit normals from (25, 3) radiance coefficients. May be slightly negative."""
    return np.asarray((basis(normal) * COSINE_LOBE) @ coefficients)


def irradiance_order(coefficients: NDArray[np.floating], max_error: float = 0.0025) -> tuple[int, float]:
    """The lowest order (0, 1, 2 or 4) whose predicted relative rms error of irradiance is below `max_error`, or 4, and that error.

    The basis is orthonormal, so the share of a band that is left out is exactly |A_l| |L_l| / |E|. Bands above 4 are not known: the
    sixth is taken to hold as much radiance a coefficient as the fourth does, which makes its irradiance 0.45 of that.
    """
    scaled = COSINE_LOBE[:, None] * coefficients
    bands = np.add.reduceat((scaled**2).sum(axis=1), [0, 1, 4, 9, 16])
    beyond = 0.45**2 / (1 - 0.45**2) * bands[4]
    whole = max(float(bands.sum() + beyond), 1e-300)
    for order in (0, 1, 2):
        error = float(np.sqrt((bands[order + 1:].sum() + beyond) / whole))
        if error <= max_error:
            return order, error
    return 4, float(np.sqrt(beyond / whole))


def disc_cosine(cosine: NDArray[np.floating], angular_radius: float) -> Array:
    """Mean of max(0, cosine) over a disc of that radius whose centre has that cosine with the normal.

    Exact while the disc is wholly above or below the horizon; in between a parabola that meets both smoothly.
    """
    c = np.asarray(cosine, dtype=np.float64)
    s = max(float(np.sin(angular_radius)), 1e-6)
    return np.where(c >= s, c, np.where(c <= -s, 0.0, (c + s) ** 2 / (4 * s)))

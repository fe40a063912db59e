"""Inverse tone mapping: from the display signal of one LDR frame to radiance, and back.

The operator of Iorns & Rhee 2015 (eq. 1-3; MR360 eq. 1-3): radiance = k * rgb with k = 10 Y^10 + 1.8 and
Y = .3 R + .59 G + .11 B. The papers leave open in which space. Here all of it is linear light: of the readings that
`make bench-light` compares on real captures (table "range"), it gives irradiance nearest to the truth. As a function of the
scalar luminance it is strictly increasing, so it can be inverted exactly: a mirror shows the video's own codes.

Peak radiance is 11.8: a clipped sun comes back far too weak. What was clipped is restored in `highlights.py` and `sun.py`.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

WEIGHTS = np.array([0.3, 0.59, 0.11])
SLOPE, OFFSET, EXPONENT = 10.0, 1.8, 10
MAX_RADIANCE = 6.0e4  # below the largest half float
INVERSE_TABLE_SIZE = 4096
_KNOTS = np.linspace(0.0, 1.0, 65536) ** 2.4


def luminance_of(radiance: NDArray[np.floating]) -> NDArray[np.floating]:
    """(..., 3) to (...) by the papers' weights (eq. 1), in the type that is given."""
    return np.asarray(radiance @ WEIGHTS.astype(radiance.dtype))


def gain(luminance: NDArray[np.floating]) -> NDArray[np.float64]:
    """k of eq. 2 for linear luminance; constant outside [0, 1]."""
    return np.asarray(SLOPE * np.clip(luminance, 0.0, 1.0) ** EXPONENT + OFFSET)


def radiance_from_linear(rgb: NDArray[np.floating]) -> NDArray[np.float64]:
    """(..., 3) linear display light in [0, 1] to radiance in [0, 11.8]. NaN, infinities and negatives become 0."""
    clean = sanitize(rgb)
    return clean * gain(clean @ WEIGHTS)[..., None]


def linear_from_radiance(radiance: NDArray[np.floating]) -> NDArray[np.float64]:
    """The inverse of `radiance_from_linear`; radiance beyond the display's white gives values above 1."""
    clean = sanitize(radiance)
    return clean / _gain_of_radiance(clean @ WEIGHTS)[..., None]


def _gain_of_radiance(luminance: NDArray[np.float64]) -> NDArray[np.float64]:
    display = np.interp(luminance, _KNOTS * gain(_KNOTS), _KNOTS)
    return gain(display)


def approximate_linear_from_radiance(radiance: NDArray[np.floating]) -> NDArray[np.float64]:
    """The same within 0.1 %, by the shader's table: for statistics of many texels."""
    position = np.sqrt(np.minimum(radiance @ WEIGHTS / (SLOPE + OFFSET), 1.0)) * (INVERSE_TABLE_SIZE - 1) + 0.5
    return np.asarray(radiance * inverse_gain_table()[position.astype(np.intp)][..., None])


def sanitize(values: NDArray[np.floating]) -> NDArray[np.float64]:
    """What may enter the renderer: finite, not negative, below half-float range. The rest is 0 (too large: the limit)."""
    v = np.asarray(values, dtype=np.float64)
    return np.where(v >= 0.0, np.minimum(v, MAX_RADIANCE), 0.0)


@lru_cache(maxsize=1)
def inverse_gain_table() -> NDArray[np.float32]:
    """(INVERSE_TABLE_SIZE,) 1 / k by `sqrt(luminance of the radiance / peak)`, for the shader's look-up."""
    peak = SLOPE + OFFSET
    position = (np.arange(INVERSE_TABLE_SIZE) / (INVERSE_TABLE_SIZE - 1)) ** 2 * peak
    return np.asarray(1.0 / _gain_of_radiance(position), dtype=np.float32)

"""Diffuse light: maps of irradiance by the direction of the normal, made from the radiance map in three ways.

`convolved` is exact; `harmonic_map` evaluates the spherical harmonics of `irradiance.py`, which is cheaper and as good where
little light is left in the bands that they lack; `diffuse_radiance_map` is the papers' (Iorns & Rhee 2015, Algorithm 1).
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from renderer.equirectangular import pixel_directions
from renderer.light.irradiance import COSINE_LOBE, basis, irradiance_order
from renderer.light.specular import azimuthal_kernel, filtered, resample, spectrum_of

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
Floats = NDArray[np.floating]
IRRADIANCE_ROWS = 48
COSINE_FREQUENCIES = 25     # over azimuth; what they leave out is part of the error that `make bench-light` prints
HARMONICS_SUFFICE = 0.0025    # predicted relative rms error of irradiance; above it the map is convolved


def convolved(radiance: Floats) -> Array32:
    """(height, width, 3) map to (IRRADIANCE_ROWS, 2 IRRADIANCE_ROWS, 3) irradiance: convolved with the clamped cosine, which on
    the equirectangular grid is a matrix product for every frequency over azimuth."""
    columns = 2 * IRRADIANCE_ROWS
    spectrum = np.fft.rfft(radiance, axis=1)[:, :COSINE_FREQUENCIES].transpose(1, 0, 2)
    parts = np.concatenate([spectrum.real, spectrum.imag], axis=2).astype(np.float32)
    filtered = _cosine_kernel(*radiance.shape[:2])[:len(parts)] @ parts
    # the spectrum of the finer columns starts half of their width further left
    turn = np.exp(1j * np.pi * np.arange(len(filtered)) * (1 / columns - 1 / radiance.shape[1]))[:, None, None]
    found = np.fft.irfft(((filtered[..., :3] + 1j * filtered[..., 3:]) * turn).transpose(1, 0, 2), n=columns, axis=1)
    return np.asarray(np.maximum(found * (columns / radiance.shape[1]), 0.0), dtype=np.float32)


@lru_cache(maxsize=4)
def _cosine_kernel(height: int, width: int) -> Array32:
    """(frequencies, rows out, height) real spectrum over azimuth of the clamped cosine times solid angle; a constant gives pi."""
    kernel = azimuthal_kernel(lambda cosine: np.maximum(cosine, 0.0), IRRADIANCE_ROWS, height, max(1, width // 2))
    return np.asarray(spectrum_of(kernel * np.float32(np.pi))[:COSINE_FREQUENCIES].copy(), dtype=np.float32)



def harmonic_map(coefficients: Array, order: int) -> Array32:
    """(25, 3) radiance coefficients to (IRRADIANCE_ROWS, 2 IRRADIANCE_ROWS, 3) irradiance from bands 0 to `order`."""
    count = (order + 1) ** 2
    found = _irradiance_basis()[:, :count] @ coefficients[:count].astype(np.float32)
    return np.asarray(np.maximum(found, 0.0).reshape(IRRADIANCE_ROWS, 2 * IRRADIANCE_ROWS, 3))


@lru_cache(maxsize=1)
def _irradiance_basis() -> Array32:
    directions = pixel_directions(IRRADIANCE_ROWS, 2 * IRRADIANCE_ROWS).reshape(-1, 3)
    return np.asarray(basis(directions) * COSINE_LOBE, dtype=np.float32)


def diffuse_radiance_map(radiance: Floats, rows: int) -> Array32:
    """The papers' map, (rows, 2 rows, 3), as irradiance: pi times what their weights normalise to.

    Algorithm 1 sums over a map of the same size as its result. It weights by the "angle between", which can only mean the clamped
    cosine of it, and by the cosine of the latitude for the area. The sum is theirs, the order of summation is not: over azimuth it
    is a convolution.
    """
    small = resample(np.asarray(radiance, dtype=np.float32), rows, 2 * rows)
    return np.asarray(filtered(small, _sampled_cosine_kernel(rows)) * np.float32(np.pi))


@lru_cache(maxsize=4)
def _sampled_cosine_kernel(rows: int) -> Array32:
    return spectrum_of(azimuthal_kernel(lambda cosine: np.maximum(cosine, 0.0), rows, rows, rows, subsamples=1))


def diffuse_map(method: str, radiance: Floats, coefficients: Array) -> Array32:
    """Irradiance by the method of that name (`Lighting.diffuse`); `coefficients` are those of this radiance."""
    if method.startswith("map"):
        return diffuse_radiance_map(radiance, int(method.split("x")[1]))
    order, error = irradiance_order(coefficients)
    if method == "sh" or (method == "auto" and error <= HARMONICS_SUFFICE):
        return harmonic_map(coefficients, order)
    return convolved(radiance)

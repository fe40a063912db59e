"""Glossy light: the radiance map filtered with the GGX lobes in use; the split sum.

Prefiltering (Karis 2013, N = V = R) is a convolution with a kernel that depends on the angle only. On the equirectangular
grid it is circular in azimuth, so a Fourier transform over the columns turns it into one small matrix product per
frequency: exact, seamless, and its matrices depend on geometry alone. Reflectance is split as F0 A + B with energy
compensation for multiple scattering (Fdez-Aguera 2019).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from renderer.equirectangular import solid_angles

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
Floats = NDArray[np.floating]
MIN_ROUGHNESS = 0.2     # a narrower lobe is nearer to a mirror than to any map this small
ROUGHNESS_STEP = 1 / 128
DFG_SIZE = 64
ROWS, MOST_ROWS = ((0.95, 16), (0.49, 32)), 64     # of prefiltered maps, by the least roughness
MIN_SHARE = 1e-4        # of a lobe under the horizon: less is no part of it
_SUBSAMPLES = 3


def quantized_roughness(roughness: float) -> float:
    """The roughness for which a map is prefiltered: rounded to a step that no eye sees, so that kernels are reused."""
    return max(MIN_ROUGHNESS, round(roughness / ROUGHNESS_STEP) * ROUGHNESS_STEP)


def map_rows(roughness: float) -> int:
    """Rows of the prefiltered map, interpolation between its texels included: rms errors of at most 2 % from roughness 0.25 on
    (`make bench-light`, table "glossy")."""
    return next((rows for least, rows in ROWS if roughness >= least), MOST_ROWS)


def ggx_lobe(cos_angle: Floats, roughness: float) -> Floats:
    """Unnormalised weight of light at an angle from the mirror direction for N = V: D(h) N.L with h half-way."""
    alpha2 = roughness**4
    cos_half2 = 0.5 * (1.0 + cos_angle)
    denominator = 1.0 + cos_half2 * (alpha2 - 1.0)
    return np.asarray(np.maximum(cos_angle, 0.0) / (denominator * denominator))


@dataclass(frozen=True)
class Lobe:
    """One prefiltered map in two, because what is under the horizon may be near: (rows, 2 rows, 4) `above`, what the lobe about
    each direction gets from over it, and the share of the lobe that is not; (rows, 2 rows, 3) `below`, the mean that this sees."""

    above: Array32
    below: Array32

    @property
    def whole(self) -> Array32:
        """(rows, 2 rows, 3): the map as one."""
        return np.asarray(self.above[..., :3] + self.above[..., 3:] * self.below)


def prefilter_all(radiance: Floats, roughnesses: set[float]) -> dict[float, Lobe]:
    """Prefiltered maps for each of these roughness values; smaller maps are made from the next larger one."""
    lobes, source = {}, radiance
    for roughness in sorted(roughnesses):
        rows = map_rows(roughness)
        if rows < source.shape[0]:
            source = resample(source, rows, 2 * rows)
        lobes[roughness] = prefilter_split(source, roughness)
    return lobes


def prefilter_split(radiance: Floats, roughness: float) -> Lobe:
    """(height, width, 3) map as a GGX lobe of that roughness sees it over and under the horizon."""
    rows = map_rows(roughness)
    small = radiance if radiance.shape[:2] == (rows, 2 * rows) else resample(radiance, rows, 2 * rows)
    kernel = _kernel(quantized_roughness(roughness), rows)
    over, under = (filtered(small[part], kernel[:, :, part]) for part in (slice(0, rows // 2), slice(rows // 2, rows)))
    share = np.broadcast_to(kernel[0, :, rows // 2:].sum(axis=1)[:, None, None], (rows, 2 * rows, 1))   # frequency 0: the sum
    return Lobe(np.concatenate([over, share], axis=2), under / np.maximum(share, MIN_SHARE))


def prefilter(radiance: Floats, roughness: float) -> Array32:
    """(height, width, 3) map to (rows, 2 rows, 3) radiance as a GGX lobe of that roughness sees it."""
    rows = map_rows(roughness)
    small = radiance if radiance.shape[:2] == (rows, 2 * rows) else resample(radiance, rows, 2 * rows)
    return filtered(small, _kernel(quantized_roughness(roughness), rows))


def filtered(radiance: Floats, kernel: Array32) -> Array32:
    """(rows in, columns, 3) map convolved with a kernel as `spectrum_of` gives it: (rows out, columns, 3), never negative."""
    spectrum = np.fft.rfft(radiance, axis=1).transpose(1, 0, 2)  # frequency, row, channel
    parts = np.concatenate([spectrum.real, spectrum.imag], axis=2).astype(np.float32)
    found = kernel @ parts
    lobes = np.fft.irfft((found[..., :3] + 1j * found[..., 3:]).transpose(1, 0, 2), n=radiance.shape[1], axis=1)
    return np.asarray(np.maximum(lobes, 0.0), dtype=np.float32)


@lru_cache(maxsize=32)
def _kernel(roughness: float, rows: int) -> Array32:
    """(frequencies, rows out, rows in) real spectrum over azimuth of the normalised, solid-angle weighted lobe."""
    return spectrum_of(azimuthal_kernel(lambda cosine: ggx_lobe(cosine, roughness), rows, rows, rows))


def spectrum_of(kernel: Array32) -> Array32:
    return np.ascontiguousarray(np.fft.rfft(kernel, axis=2).real.transpose(2, 0, 1), dtype=np.float32)


def azimuthal_kernel(lobe: Callable[[Floats], Floats], rows_out: int, rows_in: int, half_turn: int,
                     subsamples: int = _SUBSAMPLES) -> Array32:
    """(rows out, rows in, columns) weight of a texel for a direction, by the columns between them; each row out sums to 1."""
    offsets = (np.arange(subsamples, dtype=np.float32) + 0.5) / subsamples
    theta_out = ((np.arange(rows_out, dtype=np.float32) + 0.5) / rows_out * np.pi)[:, None, None]
    half = np.zeros((rows_out, rows_in, half_turn + 1), dtype=np.float32)   # the kernel is even in azimuth
    for row_offset in offsets:
        theta_in = ((np.arange(rows_in, dtype=np.float32) + row_offset) / rows_in * np.pi)[None, :, None]
        along, across = np.cos(theta_out) * np.cos(theta_in), np.sin(theta_out) * np.sin(theta_in)
        for column_offset in offsets:
            azimuth = (np.arange(half_turn + 1, dtype=np.float32) + column_offset - 0.5) / half_turn * np.pi
            half += lobe(along + across * np.cos(azimuth)) * np.sin(theta_in)
    kernel = np.concatenate([half, half[:, :, -2:0:-1]], axis=2)
    return np.asarray(kernel / kernel.sum(axis=(1, 2), keepdims=True), dtype=np.float32)


def resample(radiance: Floats, rows: int, columns: int) -> Floats:
    """Area-weighted, solid-angle-true resampling of a map to any smaller size; total power is kept to the type's accuracy."""
    height, width = radiance.shape[:2]
    if (height, width) == (2 * rows, 2 * columns):
        return _halved(radiance)
    power = radiance * solid_angles(height, width)[..., None].astype(radiance.dtype)
    if height % rows == 0 and width % columns == 0:
        power = power.reshape(rows, height // rows, width * 3).sum(axis=1)
        power = power.reshape(rows, columns, width // columns, 3).sum(axis=2)
    else:
        power = (_overlap(height, rows).astype(power.dtype) @ power.reshape(height, -1)).reshape(rows, width, 3)
        power = _overlap(width, columns).astype(power.dtype) @ power
    return np.asarray(power / solid_angles(rows, columns)[..., None].astype(power.dtype))


def _halved(radiance: Floats) -> Floats:
    """`resample` to half the size, which every frame needs."""
    angles = solid_angles(*radiance.shape[:2]).astype(radiance.dtype)[..., None]
    upper, lower = angles[::2], angles[1::2]
    both = radiance[::2] * (upper / (upper + lower)) + radiance[1::2] * (lower / (upper + lower))
    return np.asarray((both[:, ::2] + both[:, 1::2]) * radiance.dtype.type(0.5))


@lru_cache(maxsize=16)
def _overlap(source: int, target: int) -> Array:
    """(target, source) share of each source cell that lies in each target cell."""
    source_edges = np.arange(source + 1) / source
    target_edges = np.arange(target + 1) / target
    low = np.maximum(source_edges[None, :-1], target_edges[:-1, None])
    high = np.minimum(source_edges[None, 1:], target_edges[1:, None])
    return np.asarray(np.maximum(high - low, 0.0) * source)


@lru_cache(maxsize=1)
def dfg_table() -> Array32:
    """(DFG_SIZE roughness rows from 0 to 1, DFG_SIZE N.V columns, 2): scale A and bias B of F0 for one GGX lobe, F90 = 1.

    Importance-sampled with 512 stratified normals; height-correlated Smith shadowing.
    """
    n_dot_v = ((np.arange(DFG_SIZE) + 0.5) / DFG_SIZE)[None, :, None]
    alpha = ((np.arange(DFG_SIZE) / (DFG_SIZE - 1)) ** 2)[:, None, None]
    samples = 512
    u1 = (np.arange(samples) + 0.5) / samples
    phi = 2 * np.pi * ((np.arange(samples) * 0.6180339887498949) % 1.0)
    cos_h = np.sqrt((1 - u1) / (1 + (alpha**2 - 1) * u1))
    sin_h = np.sqrt(np.maximum(1 - cos_h**2, 0.0))
    v_dot_h = np.sqrt(1 - n_dot_v**2) * sin_h * np.cos(phi) + n_dot_v * cos_h
    n_dot_l = 2 * v_dot_h * cos_h - n_dot_v
    valid = (n_dot_l > 0) & (v_dot_h > 0)
    n_dot_l = np.where(valid, n_dot_l, 1.0)
    v_dot_h = np.where(valid, v_dot_h, 1.0)
    visibility = 0.5 / (n_dot_l * np.sqrt(n_dot_v**2 * (1 - alpha**2) + alpha**2)
                        + n_dot_v * np.sqrt(n_dot_l**2 * (1 - alpha**2) + alpha**2))
    weight = np.where(valid, 4 * visibility * n_dot_l * v_dot_h / cos_h, 0.0)
    fresnel = (1 - v_dot_h) ** 5
    scale, bias = ((1 - fresnel) * weight).mean(axis=2), (fresnel * weight).mean(axis=2)
    return np.stack([scale, bias], axis=-1).astype(np.float32)

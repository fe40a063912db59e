"""Light detection as MR360 publishes it (section 4.1), the baseline of ours in `detection.py`.

Resampled to 600 x 150 texels of the upper half; a small box blur; every texel above mean + 2 sigma belongs to a light, connected
by neighbourhood in the image; irradiance by eq. 4, position as the mean of the angles (eq. 5); the strongest that make up 90 % are
kept; the radiance map is clamped to the threshold. What the paper leaves open: the blur is 3 x 3, neighbours are the four
nearest, the seam is not crossed, and the ad-hoc change of brightness by solid angle is left out, for it is not given.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from renderer.light.detection import MIN_ANGULAR_RADIUS, Detection, Light
from renderer.light.inverse_tone_mapping import WEIGHTS, luminance_of

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
Floats = NDArray[np.floating]
WIDTH, HEIGHT = 600, 300      # of the whole frame; the upper half is looked at
SIGMAS = 2.0
KEPT_ENERGY = 0.9
ROUNDING = 1e-5              # of single precision, after sums
DARK = float(np.finfo(np.float32).tiny)      # below it single precision has fewer digits still: there is no light


def detect_by_threshold(upper: Array32, radiance: Floats, sigmas: float = SIGMAS) -> Detection:
    """Lights of the upper half, (150, 600, 3) radiance; `radiance`, (height, width, 3), is the map to be clamped.

    What the paper drops (weak lights, the lower half) is clamped all the same: its energy is lost.
    """
    luminance = luminance_of(upper)
    blurred = box_blurred(luminance)
    mean = float(blurred.mean(dtype=np.float64))
    sigma = float(np.sqrt(np.mean(np.square(blurred - np.float32(mean)), dtype=np.float64)))
    threshold = mean + sigmas * max(sigma, ROUNDING * mean, DARK)     # of a flat frame nothing exceeds it
    lights = strongest(_lights(upper, luminance, blurred > threshold, threshold))
    clamped = _clamped(radiance, threshold)
    return Detection(tuple(lights), clamped, clamped, threshold)


def _clamped(radiance: Floats, threshold: float) -> Floats:
    luminance = radiance @ WEIGHTS
    clamped, bright = radiance.copy(), luminance > threshold
    clamped[bright] *= (threshold / luminance[bright])[:, None]
    return clamped


def box_blurred(luminance: Floats) -> Array32:
    """3 x 3 means; at the border of the texels that are there."""
    padded = np.pad(luminance, 1, mode="edge")
    tall = padded[:-2] + padded[1:-1] + padded[2:]
    return np.asarray((tall[:, :-2] + tall[:, 1:-1] + tall[:, 2:]) * np.float32(1 / 9))


@lru_cache(maxsize=2)
def _geometry(rows: int, columns: int) -> tuple[Array, Array, Array]:
    """Polar angle by row, azimuth by column (0 is forward), solid angle by row, of the upper half of a frame."""
    theta = (np.arange(rows) + 0.5) / rows * (np.pi / 2)
    edges = np.cos(np.arange(rows + 1) / rows * (np.pi / 2))
    return theta, ((np.arange(columns) + 0.5) / columns - 0.5) * 2 * np.pi, (edges[:-1] - edges[1:]) * 2 * np.pi / columns


def _lights(upper: Array32, luminance: Floats, mask: NDArray[np.bool_], threshold: float) -> list[Light]:
    texels = np.flatnonzero(mask)
    if not len(texels):
        return []
    first, last = texels[0] // mask.shape[1], texels[-1] // mask.shape[1] + 1
    labels, count = ndimage.label(mask[first:last])
    names = labels.ravel()[texels - first * mask.shape[1]]
    theta, phi, row_angles = _geometry(*mask.shape)
    rows = texels // mask.shape[1]
    bright = luminance.ravel()[texels].astype(np.float64)
    solid_angle = row_angles[rows]
    share = solid_angle * (1 - np.minimum(1.0, threshold / np.maximum(bright, 1e-300)))
    power = share * bright      # Y(E_p), eq. 4
    colors = upper.reshape(-1, 3)[texels].T * share
    values = (*colors, power, power * theta[rows], power * phi[texels % mask.shape[1]], solid_angle)
    sums = np.stack([np.bincount(names, value, count + 1) for value in values], axis=1)[1:]
    return [_light(*one) for one in sums if one[3] > 0.0]


def _light(red: float, green: float, blue: float, power: float, theta: float, phi: float, solid_angle: float) -> Light:
    theta, phi = theta / power, phi / power
    direction = np.array([np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)])
    radius = 2 * np.arcsin(np.sqrt(min(1.0, solid_angle / (4 * np.pi))))
    return Light(direction, np.array([red, green, blue]), max(float(radius), MIN_ANGULAR_RADIUS))


def strongest(lights: list[Light]) -> list[Light]:
    """The first few in the order of strength that together have at least 90 % of the irradiance of all."""
    ordered = sorted(lights, key=lambda light: -float(light.irradiance @ WEIGHTS))
    total = np.cumsum([float(light.irradiance @ WEIGHTS) for light in ordered])
    return ordered[:int(np.searchsorted(total, KEPT_ENERGY * total[-1] * (1 - 1e-12))) + 1] if len(total) else []

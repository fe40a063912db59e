"""Finds the lamps and the sun in a radiance map and takes them out of it.

MR360 section 4: pixels brighter than a threshold form lights by connectivity; a light's irradiance is what exceeds the
threshold (eq. 4); the map is clamped under it, so that no energy counts twice. Ours differs where the paper breaks:
statistics by solid angle, components connected across the seam and around the poles, vector directions in place of mean
angles (eq. 5), the angular radius from the resultant length, a gate by contribution in place of the 90 % rule, and clamping
only under lights that are kept, so that residual + lights = map.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse

from renderer.equirectangular import pixel_directions, solid_angles
from renderer.inverse_tone_mapping import WEIGHTS
from renderer.radiance_map import RadianceMap

Array = NDArray[np.float64]
SIGMAS = 2.0
MIN_CONTRIBUTION = 0.02       # of the frame's total power, Weber's just noticeable difference
MAX_ANGULAR_RADIUS = np.radians(12.0)   # wider sources stay in the residual, where they are exact
MIN_ANGULAR_RADIUS = np.radians(0.2665)  # the sun
MAX_LIGHTS = 8
MAX_GAIN = 300.0
MAX_SPLITS = 3                # times the threshold is raised inside a component that is too wide, to find the sun in a bright sky
_EIGHT_NEIGHBOURS = np.ones((3, 3), dtype=bool)


@dataclass(frozen=True)
class Light:
    """A distant light. `direction` points to it; `irradiance` (r, g, b) is on a plane that faces it."""

    direction: Array
    irradiance: Array
    angular_radius: float
    id: int = 0
    gain: float = 1.0

    @property
    def solid_angle(self) -> float:
        return float(2 * np.pi * (1 - np.cos(self.angular_radius)))


@dataclass(frozen=True)
class Detection:
    """Lights, strongest first; `residual`, the (height, width, 3) map without them; `threshold`, a luminance."""

    lights: tuple[Light, ...]
    residual: Array
    threshold: float


def detect(radiance_map: RadianceMap) -> Detection:
    """Split a radiance map into lights and residual. Any map is accepted; a flat one has no lights."""
    luminance = luminance_of(radiance_map.rgb)
    threshold = _threshold(luminance)
    mean_irradiance = float((luminance * solid_angles(*luminance.shape)).sum()) / 4  # of a sphere
    local_threshold = np.full(luminance.shape, threshold)
    found: list[tuple[int, Light]] = []
    components: _Components | None = None
    for _ in range(MAX_SPLITS):
        labels, count = label_components(luminance > local_threshold)
        if count == 0:
            return Detection((), radiance_map.rgb, threshold)
        components = _Components(radiance_map, luminance, labels, count, local_threshold)
        found = components.lights(mean_irradiance)
        wide = [index for index, light in found if light.angular_radius > MAX_ANGULAR_RADIUS]
        if not wide:
            break
        components.raise_threshold(wide, local_threshold)
    assert components is not None
    kept = [(index, light) for index, light in found if light.angular_radius <= MAX_ANGULAR_RADIUS
            and light.irradiance @ WEIGHTS > MIN_CONTRIBUTION * mean_irradiance]
    kept = sorted(kept, key=lambda item: -float(item[1].irradiance @ WEIGHTS))[:MAX_LIGHTS]
    residual = components.residual([index for index, _ in kept])
    return Detection(tuple(light for _, light in kept), residual, threshold)


def _threshold(luminance: Array) -> float:
    """Mean + 2 sigma by solid angle, in two passes: the one-pass form cancels when sigma is small."""
    weights = solid_angles(*luminance.shape) / (4 * np.pi)
    mean = float((luminance * weights).sum())
    variance = float(((luminance - mean) ** 2 * weights).sum())
    return float(mean + SIGMAS * np.sqrt(variance))


def luminance_of(radiance: Array) -> Array:
    return np.asarray(radiance[..., 0] * WEIGHTS[0] + radiance[..., 1] * WEIGHTS[1] + radiance[..., 2] * WEIGHTS[2])


def label_components(mask: NDArray[np.bool_]) -> tuple[NDArray[np.int32], int]:
    """Number the 8-connected components of an equirectangular mask, across the seam and around both poles.

    Returns (height, width) labels, 0 where the mask is False, and the number of components.
    """
    labels, count = ndimage.label(mask, structure=_EIGHT_NEIGHBOURS)
    if count < 2:
        return labels, count
    left, right = labels[:, 0], labels[:, -1]
    pairs = [(left, right), (left[1:], right[:-1]), (left[:-1], right[1:])]
    for pole in (labels[0], labels[-1]):  # every texel of a pole row touches every other
        present = pole[pole > 0]
        if present.size:
            pairs.append((present, np.full_like(present, present[0])))
    a, b = (np.concatenate(side) for side in zip(*pairs, strict=True))
    both = (a > 0) & (b > 0) & (a != b)
    if not both.any():
        return labels, count
    graph = sparse.coo_array((np.ones(both.sum()), (a[both] - 1, b[both] - 1)), shape=(count, count))
    merged_count, merged = sparse.csgraph.connected_components(graph, directed=False)
    table = np.concatenate([[0], merged + 1]).astype(np.int32)
    return table[labels], int(merged_count)


class _Components:
    """The bright texels as flat arrays, and what each connected component of them adds up to."""

    def __init__(self, radiance_map: RadianceMap, luminance: Array, labels: NDArray[np.int32], count: int,
                 threshold: Array) -> None:
        self._map = radiance_map
        self._where = np.nonzero(labels)
        self._label = labels[self._where]
        self._count = count
        # what exceeds the threshold, keeping the colour (eq. 4)
        self._luminance = luminance[self._where]
        self._excess = radiance_map.rgb[self._where] * (1.0 - threshold[self._where] / self._luminance)[:, None]
        self._solid_angle = np.broadcast_to(solid_angles(*labels.shape), labels.shape)[self._where]

    def _sums(self, values: Array) -> Array:
        return np.asarray(np.bincount(self._label, weights=values, minlength=self._count + 1), dtype=np.float64)

    def raise_threshold(self, components: list[int], threshold: Array) -> None:
        """Half-way between its threshold and its maximum for each of these components, in place."""
        maxima = np.zeros(self._count + 1)
        np.maximum.at(maxima, self._label, self._luminance)
        rows, columns = (axis[np.isin(self._label, components)] for axis in self._where)
        labels = self._label[np.isin(self._label, components)]
        threshold[rows, columns] = 0.5 * (threshold[rows, columns] + maxima[labels])

    def lights(self, mean_irradiance: float) -> list[tuple[int, Light]]:
        """Each component's number and the light that it makes."""
        directions = pixel_directions(*self._map.clipped.shape)[self._where]
        power = self._excess * self._solid_angle[:, None]
        vectors = np.stack([[self._sums(power[:, channel] * directions[:, axis]) for axis in range(3)]
                            for channel in range(3)]).transpose(2, 0, 1)  # component, channel, axis
        totals = self._sums(luminance_of(power))
        restored = _restored_irradiance(vectors, self._sums(self._map.clipped[self._where] * self._solid_angle))
        return [(index, light) for index in range(1, self._count + 1)
                if (light := _light(vectors[index], float(totals[index]), restored[index] * mean_irradiance)) is not None]

    def residual(self, kept: list[int]) -> Array:
        """The map without the excess of the kept components."""
        residual = self._map.rgb.copy()
        taken = np.isin(self._label, kept)
        rows, columns = self._where
        residual[rows[taken], columns[taken]] -= self._excess[taken]
        return residual


def _light(vectors: Array, total: float, restored_irradiance: float) -> Light | None:
    mean_vector = WEIGHTS @ vectors
    length = float(np.linalg.norm(mean_vector))
    if length <= 0.0 or total <= 0.0:
        return None
    direction = mean_vector / length
    # a uniform cap of half-angle a has resultant length (1 + cos a) / 2
    radius = float(np.arccos(np.clip(2 * length / total - 1, -1, 1)))
    irradiance = np.maximum(vectors @ direction, 0.0)
    gain = float(np.clip(restored_irradiance / max(float(irradiance @ WEIGHTS), 1e-12), 1.0, MAX_GAIN))
    return Light(direction, irradiance * gain, max(radius, MIN_ANGULAR_RADIUS), gain=gain)


def _restored_irradiance(vectors: Array, clipped: Array) -> Array:
    """What each component is taken to give in place of what the tone curve says, in units of the frame's mean irradiance.

    The curve ends at 11.8, a sun does not. MR360 section 4.1 raises lights "of smaller solid angles" by an ad-hoc mapping. So
    do we, by the clipped solid angle: 1.5 / (1 + Omega / 0.01 sr), less for glints below 3e-4 sr. What is clipped below the
    horizon is taken for a reflection. Several candidates share one budget: a room has many lamps, but a sky has one sun.
    """
    above = np.einsum("c,ncy->n", WEIGHTS, vectors[:, :, 1:2]) > 0.0
    ratio = np.where(above, 1.5 / (1 + clipped / 0.01) * clipped / (clipped + 3e-4), 0.0)
    return np.asarray(ratio * ratio / max(float(ratio.sum()), 1e-12))

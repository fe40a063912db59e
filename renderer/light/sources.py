"""Cuts a radiance map into sources: connected bright texels, the rim that they partly cover, and what they exceed it all by.

Every step is an array operation over all components at once; their number costs nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from renderer.equirectangular import pixel_directions, solid_angles
from renderer.light.inverse_tone_mapping import luminance_of
from renderer.light.radiance_map import RadianceMap

Array = NDArray[np.float64]
Floats = NDArray[np.floating]
Indices = NDArray[np.intp]
MAX_ANGULAR_RADIUS = np.radians(22.0)   # wider sources cast no shadow to speak of
MAX_COMPONENTS = 24           # the strongest are looked at more closely
MAX_SPLITS = 3                # times the threshold is raised inside a component that is too wide, to find the sun in a bright sky
MIN_PEAK = 3.0                # a component too wide is looked into if its maximum is so many thresholds; else it is a bright sky
MAX_AXIS_RATIO = 3.0          # of a source; longer ones are split along
MAX_PARTS = 4
_EIGHT_NEIGHBOURS = np.ones((3, 3), dtype=bool)


@dataclass(frozen=True)
class Source:
    """Texels of one source as flat indices, and what they exceed their surroundings by: (n, 3) radiance."""

    texels: Indices
    excess: Array


class Grid:
    """One radiance map as flat arrays of texels."""

    def __init__(self, radiance_map: RadianceMap) -> None:
        self.shape = radiance_map.clipped.shape
        self.rgb = radiance_map.rgb.reshape(-1, 3)
        self.clipped = radiance_map.clipped.ravel()
        self.raised = None if radiance_map.raised is None else radiance_map.raised.ravel()
        self.luminance = radiance_map.luminance.ravel()
        self.directions = pixel_directions(*self.shape).reshape(-1, 3)
        self._row_angles = solid_angles(*self.shape)[:, 0]

    def solid_angle(self, texels: Indices) -> Array:
        return np.asarray(self._row_angles[texels // self.shape[1]])

    def statistics(self) -> tuple[float, float]:
        """Mean and standard deviation of luminance by solid angle, in two passes: one pass cancels when sigma is small."""
        weights = self._row_angles / (4 * np.pi)
        luminance = self.luminance.reshape(self.shape)
        mean = float(weights @ luminance.sum(axis=1, dtype=np.float64))
        away = luminance - luminance.dtype.type(mean)
        return mean, float(np.sqrt(weights @ np.einsum("ij,ij->i", away, away, dtype=np.float64)))


def find_sources(grid: Grid, threshold: float, negligible: float, most: int) -> list[Source]:
    """The strongest sources, at most so many, that may exceed the `negligible` irradiance; long ones in parts. No texel has two."""
    bright = _components(grid, threshold, negligible)
    if bright is None:
        return []
    covered = bright.joined(_ring(bright, grid.shape))
    level = _levels(grid, _ring(covered, grid.shape), threshold)
    excess = np.maximum(grid.rgb[covered.texels] - level[covered.names], 0.0)
    names = _parts(grid, covered, excess)
    order = np.argsort(names, kind="stable")
    texels, excess = covered.texels[order], excess[order]
    starts = np.flatnonzero(np.diff(names[order], prepend=-1))
    power = np.add.reduceat(luminance_of(excess) * grid.solid_angle(texels), starts)
    best = np.argsort(-power, kind="stable")[:most]
    ends = np.append(starts[1:], len(texels))
    return [Source(texels[starts[i]:ends[i]], excess[starts[i]:ends[i]]) for i in best]


def source_at(grid: Grid, texels: Indices, threshold: float) -> Source:
    """What these texels exceed their surroundings by, bright or not."""
    ring = np.setdiff1d(_neighbours(*grid.shape)[texels], texels)
    ring = ring[grid.luminance[ring] <= threshold]
    weights = grid.solid_angle(ring)
    level = weights @ grid.rgb[ring] / max(float(weights.sum()), 1e-300)
    return Source(texels, np.maximum(grid.rgb[texels] - level, 0.0))


class _Segments:
    """Texels with their labels, 1 to `count`, in the order of the labels, so that sums over each label are one call."""

    def __init__(self, texels: Indices, names: Indices, count: int) -> None:
        order = np.argsort(names, kind="stable")
        self.texels, self.names, self.count = texels[order], names[order], count
        self._starts = np.flatnonzero(np.diff(self.names, prepend=-1))
        self._present = self.names[self._starts]

    def sums(self, values: Array) -> Array:
        """(count + 1, ...) sums of (n, ...) values by label."""
        result = np.zeros((self.count + 1, *values.shape[1:]))
        if len(self._starts):
            result[self._present] = np.add.reduceat(values, self._starts, axis=0)
        return result

    def maxima(self, values: Floats) -> Array:
        """(count + 1,) largest of (n,) values that are not negative, by label."""
        result = np.zeros(self.count + 1)
        result[self._present] = np.maximum.reduceat(values, self._starts)
        return result

    def joined(self, other: _Segments) -> _Segments:
        return _Segments(np.concatenate([self.texels, other.texels]), np.concatenate([self.names, other.names]), self.count)


def _components(grid: Grid, threshold: float, negligible: float) -> _Segments | None:
    """Connected texels above the threshold; of those that are too wide for a light, what a higher one leaves."""
    above: float | Floats = threshold
    for _ in range(MAX_SPLITS):
        mask = grid.luminance > above
        texels = np.flatnonzero(mask)
        labels, count = label_components(mask.reshape(grid.shape))
        if count == 0:
            return None
        segments = _Segments(texels, labels.ravel()[texels].astype(np.intp), count)
        luminance, weights = grid.luminance[segments.texels], grid.solid_angle(segments.texels)
        least = above[segments.texels] if isinstance(above, np.ndarray) else above
        power = (luminance - least) * weights
        sums = segments.sums(np.column_stack([power, power[:, None] * grid.directions[segments.texels], luminance * weights]))
        # a uniform cap of half-angle a has resultant length (1 + cos a) / 2
        resultant = np.linalg.norm(sums[:, 1:4], axis=1) / np.maximum(sums[:, 0], 1e-300)
        wide = np.arccos(np.clip(2 * resultant - 1, -1, 1)) > MAX_ANGULAR_RADIUS
        # a rim may add as much again
        strong = (sums[:, 4] > 0.5 * negligible) & (sums[:, 0] > 0.0)
        maxima = segments.maxima(luminance)
        peaked = wide & strong & (maxima > MIN_PEAK * threshold)
        if not peaked.any():
            break
        raised = peaked[segments.names]
        if not isinstance(above, np.ndarray):
            above = np.full(grid.luminance.size, threshold)
        above[segments.texels[raised]] = (0.5 * (least + maxima[segments.names]))[raised]
    kept = np.flatnonzero(strong & ~wide)
    kept = kept[np.argsort(-sums[kept, 4], kind="stable")][:MAX_COMPONENTS]
    table = np.zeros(count + 1, dtype=np.intp)
    table[kept] = np.arange(1, len(kept) + 1)
    names = table[segments.names]
    return _Segments(segments.texels[names > 0], names[names > 0], len(kept)) if len(kept) else None


@lru_cache(maxsize=4)
def _neighbours(height: int, width: int) -> NDArray[np.int32]:
    """(height * width, 8) flat indices of the texels that touch each one, across the seam and over the poles."""
    rows, columns = np.divmod(np.arange(height * width), width)
    found = []
    for down in (-1, 0, 1):
        for right in (-1, 0, 1):
            row, column = rows + down, columns + right
            over = (row < 0) | (row >= height)
            column = np.where(over, column + width // 2, column) % width
            found.append(np.clip(row, 0, height - 1) * width + column)
    del found[4]    # the texel itself
    return np.stack(found, axis=1).astype(np.int32)


def _ring(segments: _Segments, shape: tuple[int, ...]) -> _Segments:
    """The texels that touch these and are none of them, with the highest label that touches them."""
    around = _neighbours(shape[0], shape[1])[segments.texels].ravel()
    names, order = np.zeros(shape[0] * shape[1], dtype=np.intp), np.zeros(shape[0] * shape[1], dtype=np.intp)
    # in the order of the labels, and of several values for one place the last one stays
    names[around] = np.repeat(segments.names, 8)
    names[segments.texels] = 0
    order[around] = np.arange(len(around))
    once = around[(order[around] == np.arange(len(around))) & (names[around] > 0)]
    return _Segments(once, names[once], segments.count)


def _levels(grid: Grid, ring: _Segments, threshold: float) -> Array:
    """(count + 1, 3) mean radiance of each label's ring, without what is bright there itself."""
    weights = grid.solid_angle(ring.texels) * (grid.luminance[ring.texels] <= threshold)
    sums = ring.sums(np.column_stack([weights, weights[:, None] * grid.rgb[ring.texels]]))
    return np.asarray(sums[:, 1:] / np.maximum(sums[:, :1], 1e-300))


def _parts(grid: Grid, segments: _Segments, excess: Array) -> Indices:
    """A name for each texel: its label, and for a long source the part along the major axis."""
    directions = grid.directions[segments.texels]
    power = luminance_of(excess) * grid.solid_angle(segments.texels)
    total = np.maximum(segments.sums(power), 1e-300)
    centres = segments.sums(power[:, None] * directions) / total[:, None]
    away = directions - centres[segments.names]
    moments = segments.sums((power[:, None] * away)[:, :, None] * away[:, None, :]) / total[:, None, None]
    variances, axes = np.linalg.eigh(moments)
    thinnest = (np.pi / grid.shape[0]) ** 2 / 12        # a source is no thinner than a texel
    ratios = np.sqrt(np.maximum(variances[:, 2], thinnest) / np.maximum(variances[:, 1], thinnest))
    if not (ratios > MAX_AXIS_RATIO).any():
        return segments.names * MAX_PARTS
    numbers = np.where(ratios > MAX_AXIS_RATIO, np.clip(np.round(ratios / 2), 2, MAX_PARTS), 1)[segments.names]
    along = (away * axes[segments.names, :, 2]).sum(axis=1)
    reach = np.sqrt(3 * np.maximum(variances[:, 2], 1e-300))[segments.names]     # half of a uniform strip with that variance
    part = np.clip(np.floor((along / reach + 1) / 2 * numbers), 0, numbers - 1)
    return np.asarray(segments.names * MAX_PARTS + part, dtype=np.intp)


def label_components(mask: NDArray[np.bool_]) -> tuple[NDArray[np.int32], int]:
    """Number the 8-connected components of an equirectangular mask, across the seam and around both poles.

    Returns (height, width) labels, 0 where the mask is False, and the number of components.
    """
    labels = np.zeros(mask.shape, dtype=np.int32)
    rows = np.flatnonzero(mask.any(axis=1))
    if not len(rows):
        return labels, 0
    band = slice(rows[0], rows[-1] + 1)
    count = ndimage.label(mask[band], structure=_EIGHT_NEIGHBOURS, output=labels[band])
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
    table = _merged(np.unique(np.stack([a[both], b[both]], axis=1), axis=0), count)
    return table[labels], int(table.max())


def _merged(pairs: NDArray[np.int32], count: int) -> NDArray[np.int32]:
    """(count + 1,) new labels without gaps, the same for both of each pair; they are few, the components that touch an edge."""
    parent = list(range(count + 1))

    def root(label: int) -> int:
        while parent[label] != label:
            parent[label] = label = parent[parent[label]]
        return label

    for first, second in pairs.tolist():
        parent[max(root(first), root(second))] = min(root(first), root(second))
    roots = np.array([root(label) for label in range(count + 1)])
    return np.asarray(np.unique(roots, return_inverse=True)[1], dtype=np.int32)

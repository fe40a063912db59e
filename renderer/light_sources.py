"""Cuts a radiance map into sources: connected bright texels, the rim that they partly cover, and what they exceed it all by.

Every step is an array operation over all components at once; their number costs nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse

from renderer.equirectangular import pixel_directions, solid_angles
from renderer.inverse_tone_mapping import WEIGHTS
from renderer.radiance_map import RadianceMap

Array = NDArray[np.float64]
Floats = NDArray[np.floating]
Indices = NDArray[np.intp]
Labels = NDArray[np.int32]      # (height, width); 0 is none
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


def luminance_of(radiance: Array) -> Array:
    return np.asarray(radiance @ WEIGHTS)


def find_sources(grid: Grid, threshold: float, negligible: float, most: int) -> list[Source]:
    """The strongest sources, at most so many, that may exceed the `negligible` irradiance; long ones in parts. No texel has two."""
    labels = _components(grid, threshold, negligible)
    if labels is None:
        return []
    covered = _spread(labels, labels > 0)
    segments = _Segments(np.flatnonzero(covered), covered)
    level = _levels(grid, _spread(covered, covered > 0) * (covered == 0), threshold, int(labels.max()))
    excess = np.maximum(grid.rgb[segments.texels] - level[segments.names], 0.0)
    names = _parts(grid, segments, excess)
    order = np.argsort(names, kind="stable")
    texels, excess = segments.texels[order], excess[order]
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
    """Labelled texels in the order of their labels, so that sums over each label are one call."""

    def __init__(self, texels: Indices, labels: Labels) -> None:
        names = labels.ravel()[texels]
        order = np.argsort(names, kind="stable")
        self.texels, self.names = texels[order], names[order]
        self._starts = np.flatnonzero(np.diff(self.names, prepend=-1))
        self.present = self.names[self._starts]

    def sums(self, values: Array, count: int) -> Array:
        """(count + 1, ...) sums of (n, ...) values by label."""
        result = np.zeros((count + 1, *values.shape[1:]))
        if len(self._starts):
            result[self.present] = np.add.reduceat(values, self._starts, axis=0)
        return result

    def maxima(self, values: Floats, count: int) -> Array:
        """(count + 1,) largest of (n,) values that are not negative, by label."""
        result = np.zeros(count + 1)
        result[self.present] = np.maximum.reduceat(values, self._starts)
        return result


def _components(grid: Grid, threshold: float, negligible: float) -> Labels | None:
    """Connected texels above the threshold, 1 to n; of those that are too wide for a light, what a higher one leaves."""
    above = np.full(grid.luminance.size, threshold)
    for _ in range(MAX_SPLITS):
        labels, count = label_components((grid.luminance > above).reshape(grid.shape))
        if count == 0:
            return None
        segments = _Segments(np.flatnonzero(labels), labels)
        texels, names = segments.texels, segments.names
        weights = grid.solid_angle(texels)
        power = (grid.luminance[texels] - above[texels]) * weights
        sums = segments.sums(np.column_stack([
            power, power[:, None] * grid.directions[texels], grid.luminance[texels] * weights]), count)
        # a uniform cap of half-angle a has resultant length (1 + cos a) / 2
        resultant = np.linalg.norm(sums[:, 1:4], axis=1) / np.maximum(sums[:, 0], 1e-300)
        wide = np.arccos(np.clip(2 * resultant - 1, -1, 1)) > MAX_ANGULAR_RADIUS
        # a rim may add as much again
        strong = (sums[:, 4] > 0.5 * negligible) & (sums[:, 0] > 0.0)
        maxima = segments.maxima(grid.luminance[texels], count)
        peaked = wide & strong & (maxima > MIN_PEAK * threshold)
        if not peaked.any():
            break
        raised = peaked[names]
        above[texels[raised]] = 0.5 * (above[texels[raised]] + maxima[names[raised]])
    kept = np.flatnonzero(strong & ~wide)
    kept = kept[np.argsort(-sums[kept, 4], kind="stable")][:MAX_COMPONENTS]
    table = np.zeros(count + 1, dtype=np.int32)
    table[kept] = np.arange(1, len(kept) + 1)
    return table[labels] if len(kept) else None


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


def _spread(labels: Labels, present: NDArray[np.bool_]) -> Labels:
    """Labels and those of the texels that touch them; labelled texels keep theirs, others have the highest that touches them."""
    segments = _Segments(np.flatnonzero(present), labels)
    spread = np.zeros_like(labels)
    # sorted by label, and of several values for one place the last one stays
    spread.ravel()[_neighbours(*labels.shape)[segments.texels]] = segments.names[:, None]
    return np.where(present, labels, spread)


def _levels(grid: Grid, ring: Labels, threshold: float, count: int) -> Array:
    """(count + 1, 3) mean radiance of each label's ring, without what is bright there itself."""
    segments = _Segments(np.flatnonzero((ring.ravel() > 0) & (grid.luminance <= threshold)), ring)
    weights = grid.solid_angle(segments.texels)
    sums = segments.sums(np.column_stack([weights, weights[:, None] * grid.rgb[segments.texels]]), count)
    return np.asarray(sums[:, 1:] / np.maximum(sums[:, :1], 1e-300))


def _parts(grid: Grid, segments: _Segments, excess: Array) -> Indices:
    """A name for each texel: its label, and for a long source the part along the major axis."""
    count = int(segments.names.max())
    directions = grid.directions[segments.texels]
    power = luminance_of(excess) * grid.solid_angle(segments.texels)
    total = np.maximum(segments.sums(power, count), 1e-300)
    centres = segments.sums(power[:, None] * directions, count) / total[:, None]
    away = directions - centres[segments.names]
    moments = segments.sums(power[:, None, None] * away[:, :, None] * away[:, None, :], count) / total[:, None, None]
    variances, axes = np.linalg.eigh(moments)
    thinnest = (np.pi / grid.shape[0]) ** 2 / 12        # a source is no thinner than a texel
    ratios = np.sqrt(np.maximum(variances[:, 2], thinnest) / np.maximum(variances[:, 1], thinnest))
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
    graph = sparse.coo_array((np.ones(both.sum()), (a[both] - 1, b[both] - 1)), shape=(count, count))
    merged_count, merged = sparse.csgraph.connected_components(graph, directed=False)
    table = np.concatenate([[0], merged + 1]).astype(np.int32)
    return table[labels], int(merged_count)

"""Finds the lamps and the sun in a radiance map and takes them out of it.

MR360 section 4: pixels brighter than a threshold form lights by connectivity; what exceeds their surroundings is their
irradiance (eq. 4); the map is lowered under them, so that no energy counts twice. Ours differs where the paper breaks:
statistics by solid angle, components connected across the seam and around the poles, a rim of texels that a small light only
partly covers, the surroundings in place of the threshold as what is left in the map, vector directions in place of mean angles
(eq. 5), the angular radius from the resultant length, a gate by contribution in place of the 90 % rule, long sources in parts,
and lowering only under lights that are kept, so that residual + lights = map.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from renderer.light.highlights import MAX_GAIN
from renderer.light.inverse_tone_mapping import WEIGHTS, luminance_of
from renderer.light.radiance_map import RadianceMap
from renderer.light.sources import Grid, Source, find_sources, source_at
from renderer.light.sun import Sun

Array = NDArray[np.float64]
Floats = NDArray[np.floating]
SIGMAS = 2.0
MIN_CONTRIBUTION = 0.02       # of the frame's total power, Weber's just noticeable difference
WIDE_ANGULAR_RADIUS = np.radians(9.0)   # wider ones light surfaces from the map, which is exact for them
MIN_ANGULAR_RADIUS = np.radians(0.2665)  # the sun
MAX_LIGHTS = 8
NEGLIGIBLE = 0.35 * MIN_CONTRIBUTION    # a light that is there already dies a little above that
MAX_CANDIDATES = 16
NOTHING = Source(np.zeros(0, dtype=np.intp), np.zeros((0, 3)))


@dataclass(frozen=True)
class Light:
    """A distant light. `direction` points to it; `irradiance` (r, g, b) is on a plane that faces it; `gain` is how much of it was
    restored: irradiance over what the tone curve says; at its limit for a sun that the frame does not show at all."""

    direction: Array
    irradiance: Array
    angular_radius: float
    id: int = 0
    gain: float = 1.0
    is_wide: bool = False   # too wide to be a direction: for surfaces it stays in the map, for shadows it is a light

    @property
    def solid_angle(self) -> float:
        return float(2 * np.pi * (1 - np.cos(self.angular_radius)))


@dataclass(frozen=True)
class Detection:
    """Lights, strongest first; `residual`, the (height, width, 3) map without them; `soft`, the map without those that are
    not wide, which is what lights surfaces besides; `threshold`, a luminance; `is_settled`, whether no light is being born or
    fades, so that the next frame, were it the same, would have the same lights."""

    lights: tuple[Light, ...]
    residual: Floats
    soft: Floats
    threshold: float
    is_settled: bool = True


@dataclass(frozen=True)
class Candidate:
    """A light that may be kept, and what would be taken out of the map for it. `contribution`: of the frame's power."""

    light: Light
    source: Source
    contribution: float
    is_clipped: bool


@dataclass(frozen=True)
class Found:
    """What one map shows: candidates, strongest first; its mean luminance; the threshold."""

    grid: Grid
    candidates: tuple[Candidate, ...]
    mean: float
    threshold: float

    def again(self, source: Source) -> Candidate | None:
        """What is left where an earlier frame had this source, if it is below the threshold now."""
        taken = np.zeros(self.grid.luminance.size, dtype=bool)
        for candidate in self.candidates:
            taken[candidate.source.texels] = True
        texels = source.texels[~taken[source.texels]]
        if not len(texels):
            return None
        found = _candidates(self.grid, [source_at(self.grid, texels, self.threshold)], max(np.pi * self.mean, 1e-300))
        return found[0] if found else None

    def detection(self, kept: list[tuple[Light, Source, float]]) -> Detection:
        """These lights, and the map without these shares of their sources."""
        flat = self.grid.rgb.copy()
        for _, source, share in kept:
            flat[source.texels] -= share * source.excess
        residual = soft = flat.reshape(*self.grid.shape, 3)
        lights = tuple(replace(light, is_wide=bool(light.angular_radius > WIDE_ANGULAR_RADIUS)) for light, _, _ in kept)
        wide = [(share * source.excess, source.texels)
                for light, (_, source, share) in zip(lights, kept, strict=True) if light.is_wide]
        if wide:
            soft = residual.copy()
            for radiance, texels in wide:
                soft.reshape(-1, 3)[texels] += radiance
        return Detection(lights, residual, soft, self.threshold)


def find_candidates(radiance_map: RadianceMap, sigmas: float | None = None, sun: Sun | None = None) -> Found:
    """All sources above the threshold of mean + 2 sigma that are near the gate, and the sun.

    `sigmas` in place of 2. The sun is no part of the map: it comes on top of it.
    """
    grid = Grid(radiance_map)
    mean, sigma = grid.statistics()
    threshold = mean + (SIGMAS if sigmas is None else sigmas) * sigma
    whole = max(np.pi * mean, 1e-300)   # irradiance of a sphere: a quarter of 4 pi times the mean
    sources = find_sources(grid, threshold, NEGLIGIBLE * whole, MAX_CANDIDATES)
    candidates = _candidates(grid, sources, whole)
    if sun is not None:
        light = Light(sun.direction, sun.irradiance, MIN_ANGULAR_RADIUS, gain=MAX_GAIN)
        candidates.append(Candidate(light, NOTHING, float(sun.irradiance @ WEIGHTS) / whole, is_clipped=True))
    return Found(grid, tuple(sorted(candidates, key=lambda item: -item.contribution)), mean, threshold)


def _candidates(grid: Grid, sources: list[Source], whole_irradiance: float) -> list[Candidate]:
    """Light and contribution of each source that has any power; all of them at once."""
    if not sources:
        return []
    texels, excess = (np.concatenate(parts) for parts in zip(*((one.texels, one.excess) for one in sources), strict=True))
    starts = np.cumsum([0, *(len(one.texels) for one in sources[:-1])])
    power = excess * grid.solid_angle(texels)[:, None]
    luminance = luminance_of(power)
    vectors = np.add.reduceat(power[:, :, None] * grid.directions[texels][:, None, :], starts)     # source, channel, axis
    totals = np.add.reduceat(luminance, starts)
    means = np.einsum("c,sca->sa", WEIGHTS, vectors)
    lengths = np.sqrt((means**2).sum(axis=1))
    directions = means / np.maximum(lengths, 1e-300)[:, None]
    irradiances = np.maximum(np.einsum("sca,sa->sc", vectors, directions), 0.0)
    # a uniform cap of half-angle a has resultant length (1 + cos a) / 2
    radii = np.maximum(np.arccos(np.clip(2 * lengths / np.maximum(totals, 1e-300) - 1, -1, 1)), MIN_ANGULAR_RADIUS)
    shown = totals if grid.raised is None else np.add.reduceat(luminance / grid.raised[texels], starts)
    gains = totals / np.maximum(shown, 1e-300)
    clipped = np.add.reduceat(grid.clipped[texels], starts) > 0.0
    contributions = irradiances @ WEIGHTS / whole_irradiance
    return [Candidate(Light(directions[i], irradiances[i], float(radii[i]), gain=float(gains[i])), source, float(contributions[i]),
                      bool(clipped[i])) for i, source in enumerate(sources) if lengths[i] > 0.0 and totals[i] > 0.0]

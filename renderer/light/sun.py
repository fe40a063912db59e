"""The sun that has drowned in a clipped sky: whether it is there, where, and how strong.

A clear sky with the sun in it is blue far from a clipped region, which is round or grows steadily when the level is lowered
and has no red rim, as that of a sun at or below the horizon has. Its direct irradiance is about six times what its sky gives
the ground (clear skies: four to eight, whatever the height of the sun), and white; less, down to twice, if the ground shows no
contrast that such a sun would make between what it lights and what it does not. It stands in the middle of the aureole, not of
the clipped region, which the horizon cuts (`aureole.py`). The bounds below come from two captures with such a sun and fifteen
without it (`make bench-light`, table "range"): few.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from renderer.equirectangular import pixel_directions, solid_angles
from renderer.light.aureole import HORIZON, MIN_TEXELS, SkySamples, fitted_sun
from renderer.light.inverse_tone_mapping import approximate_linear_from_radiance, luminance_of
from renderer.light.radiance_map import RadianceMap
from renderer.light.sources import label_components

Array = NDArray[np.float64]
Floats = NDArray[np.floating]
WHITE, HALF_WHITE = 0.95, 0.5
MIN_REGION_SR = 1e-3            # times the sine of its height; a smaller clipped region is a lamp or a glint
DIRECT_TO_SKY = (2.0, 6.0)      # irradiance facing the sun, in units of that of the sky on the ground: least and usual
SHADED_SHARE = 0.02             # of the ground; as dark as its shadows, if there are any
GROUND, LEAST_SINE = -0.15, 0.2     # heights: of directions that are ground below, and of the sun
BLUE = (0.8, 1.2)               # ln(blue / red) far from the region: no clear sky below, one above
REDDENED = (0.75, 0.9)          # red / green of the rim: not below, the sun is down above
SLACK = (2.0, 2.6)              # exponent of the growth of what is brighter than a level: an aureole below, a mere bright sky above
MIN_SCORE = 0.02
WEATHER_EVERY = 5               # frames; it changes more slowly than the sun moves in a turning camera
RIM, FAR = np.radians((4.0, 12.0)), np.radians(40.0)
ELONGATED = (1.05, 1.2)         # of the region; a disc is the sun however fast it grows
LOWEST_SUN = np.radians(3.0)
OUTLINE = 50                    # points of the region that stand for its outline


@dataclass(frozen=True)
class Sky:
    """How clear it is and how sure that the sun is in it, both 0 to 1; the direction to the sun (None: there is none); by how
    much the ground's middle is brighter than its shadows, less 1: what the sun gives it in units of what the sky does, at most."""

    clear: float
    score: float
    direction: Array | None
    contrast: float = np.inf


@dataclass(frozen=True)
class Sun:
    """`direction` to it; its (3,) irradiance on a plane that faces it."""

    direction: Array
    irradiance: Array


NO_SKY = Sky(0.0, 0.0, None)


class SunFinder:
    """Looks at the sky of one frame after another; keeps where the sun was."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        self._last: Array | None = None
        self._weather, self._contrast = (0.0, 0.0), np.inf
        self._age = 0

    def look(self, radiance_map: RadianceMap) -> Sky:
        """At a map as the tone curve gives it."""
        upper = radiance_map.clipped[:radiance_map.clipped.shape[0] // 2]
        sky = self._look(radiance_map) if upper.any() else NO_SKY
        self._last = sky.direction
        return sky

    def _look(self, radiance_map: RadianceMap) -> Sky:
        shown = _Shown(radiance_map)
        region = shown.region()
        if region is None:
            self._age = 0
            return NO_SKY
        if self._age % WEATHER_EVERY == 0:
            self._weather, self._contrast = shown.clearness(region), shown.ground_contrast()
        self._age += 1
        clear, score = self._weather[0], self._weather[0] * self._weather[1]
        if score < MIN_SCORE:
            return Sky(clear, 0.0, None)
        return Sky(clear, score, self._direction(radiance_map, shown, region), self._contrast)

    def _direction(self, radiance_map: RadianceMap, shown: _Shown, region: _Region) -> Array:
        fitted = fitted_sun(radiance_map, shown.samples(), region.centre, self._last)
        if fitted is not None and float(np.arccos(np.clip(fitted @ region.centre, -1, 1))) < region.reach:
            return fitted
        return region.low_sun() if region.lowest < HORIZON else region.centre


def sun_in(sky: Sky, restored: RadianceMap) -> Sun | None:
    """The sun of a sky, as strong as the map with its glow restored says."""
    if sky.direction is None:
        return None
    height, width = restored.rgb.shape[:2]
    upward = np.maximum(pixel_directions(height, width)[:, :1, 1], 0.0) * solid_angles(height, width)
    on_the_ground = float(restored.luminance.sum(axis=1, dtype=np.float64) @ upward[:, 0])
    ratio = float(np.clip(sky.contrast / max(float(sky.direction[1]), LEAST_SINE), *DIRECT_TO_SKY))
    return Sun(sky.direction, np.full(3, sky.score * ratio * on_the_ground))


@dataclass(frozen=True)
class _Region:
    """The largest clipped region: its texels, their solid angles and directions."""

    texels: NDArray[np.intp]
    angles: Array
    directions: Array

    @cached_property
    def centre(self) -> Array:
        summed = self.angles @ self.directions
        return np.asarray(summed / np.linalg.norm(summed))

    @property
    def reach(self) -> float:
        """Angle from the centre to the farthest texel."""
        return float(np.arccos(np.clip((self.directions @ self.centre).min(), -1, 1)))

    @property
    def lowest(self) -> float:
        return float(self.directions[:, 1].min())

    @property
    def radius(self) -> float:
        """Of a disc of the same solid angle."""
        return float(np.arccos(np.clip(1 - self.angles.sum() / (2 * np.pi), -1, 1)))

    @property
    def elongation(self) -> float:
        """1 for a disc: the radius by the resultant length (`detection.py`) over that by the solid angle."""
        resultant = float(np.linalg.norm(self.angles @ self.directions) / self.angles.sum())
        return float(np.arccos(np.clip(2 * resultant - 1, -1, 1))) / max(self.radius, 1e-6)

    def low_sun(self) -> Array:
        """Of a round aureole that the horizon cuts: straight below its top, by its radius."""
        top = float(np.quantile(np.arcsin(np.clip(self.directions[:, 1], -1, 1)), 0.98))
        elevation = max(top - self.radius, LOWEST_SUN)
        along = self.centre * (1.0, 0.0, 1.0)
        along *= np.cos(elevation) / max(float(np.linalg.norm(along)), 1e-9)
        along[1] = np.sin(elevation)
        return along


def _halved(values: Floats) -> Floats:
    """A map at half its size, where that can be."""
    if values.shape[0] % 2 or values.shape[1] % 2:
        return values
    return np.asarray(0.25 * (values[::2, ::2] + values[1::2, ::2] + values[::2, 1::2] + values[1::2, 1::2]))


class _Shown:
    """One map, at half its size, as the display shows it."""

    def __init__(self, radiance_map: RadianceMap) -> None:
        self._rgb = approximate_linear_from_radiance(_halved(radiance_map.rgb))
        self._clipped = _halved(radiance_map.clipped)
        self._luminance = luminance_of(self._rgb)
        size = self._clipped.shape
        self._directions, self._angles = pixel_directions(*size), np.broadcast_to(solid_angles(*size), size)
        self._height = self._directions[..., 1]

    def region(self) -> _Region | None:
        """The clipped region that gives the ground most, if it is large enough."""
        labels, count = label_components(self._luminance > WHITE)
        weights = np.bincount(labels.ravel(), (self._angles * np.maximum(self._height, 0.0)).ravel(), count + 1)
        weights[0] = 0.0
        best = int(np.argmax(weights))
        if weights[best] < MIN_REGION_SR:
            return None
        texels = np.flatnonzero(labels.ravel() == best)
        return _Region(texels, self._angles.ravel()[texels], self._directions.reshape(-1, 3)[texels])

    def ground_contrast(self) -> float:
        """Of the median to the darkest few hundredths of what is below the horizon, less 1; infinite if there is no ground."""
        luminance = self._luminance[self._height < GROUND]
        if not len(luminance):
            return np.inf
        shaded, middle = np.quantile(luminance, (SHADED_SHARE, 0.5))    # near the nadir texels are smaller: they count for more
        return float(middle / max(float(shaded), 1e-3) - 1.0)

    def samples(self) -> SkySamples:
        return SkySamples(self._rgb.reshape(-1, 3), self._clipped.ravel(), self._directions.reshape(-1, 3), self._angles.ravel())

    def clearness(self, region: _Region) -> tuple[float, float]:
        """Whether the sky is clear far from the region, and whether the region is an aureole with the sun in it."""
        outline = region.directions[::max(1, len(region.directions) // OUTLINE)]
        half = slice(0, len(self._height) // 2, 2), slice(None, None, 2)
        dim = self._clipped[half] < 0.01
        colors, directions = self._rgb[half][dim], self._directions[half][dim]
        nearest, height = (directions @ outline.T).max(axis=1, initial=-1.0), directions[:, 1]
        far = colors[(nearest < np.cos(FAR)) & (height > 0.2)]
        rim = colors[(nearest < np.cos(RIM[0])) & (nearest > np.cos(RIM[1])) & (height > HORIZON)]
        if len(far) < MIN_TEXELS or len(rim) < MIN_TEXELS // 4:
            return 0.0, 0.0
        red, _, blue = np.maximum(np.median(far, axis=0), 1e-3)
        rim_red, rim_green, _ = np.maximum(np.median(rim, axis=0), 1e-3)
        brighter = float(self._angles[self._luminance > HALF_WHITE].sum() / region.angles.sum())
        growth = np.log(max(brighter, 1.0)) / np.log(WHITE / HALF_WHITE)
        aureole = max(1 - _step(growth, SLACK), 1 - _step(region.elongation, ELONGATED))
        return _step(np.log(blue / red), BLUE), (1 - _step(rim_red / rim_green, REDDENED)) * aureole


def _step(value: float, edges: tuple[float, float]) -> float:
    t = float(np.clip((value - edges[0]) / (edges[1] - edges[0]), 0.0, 1.0))
    return t * t * (3 - 2 * t)

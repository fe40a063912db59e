"""The place the synthetic camera stands in: sky, hills, houses, paving and round posts.

Everything that does not move is worked out once, split so that a moving sun is one multiplication later:
`radiance = ambient + ground * ground_lit + objects * object_lit`, where the two `lit` fields say how much of the sun
reaches a pixel. Directions are right-handed, +Y up, -Z forward; azimuth 0 is forward and grows to the right.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]

CAMERA_HEIGHT_M = 1.6
SUN_STRENGTH = 1.15                                     # what the sun adds to a white wall facing it, linear
SKY_AMBIENT = np.array([0.28, 0.34, 0.47], np.float32)  # what the sky adds to a white surface: its own irradiance / pi
HAZE = np.array([0.50, 0.56, 0.64], np.float32)
ZENITH = np.array([0.20, 0.29, 0.45], np.float32)
HORIZON_BAND_RAD = float(np.radians(11.0))              # hills and houses stay below this elevation


@dataclass(frozen=True)
class Post:
    """An upright cylinder on the ground: axis at (x, z), in metres."""

    x: float
    z: float
    radius: float
    height: float
    albedo: tuple[float, float, float]


# So far from the camera that no shadow ever passes under it, and from each other that none falls on another post.
POSTS = (
    Post(-3.3, -3.2, 0.09, 0.95, (0.55, 0.16, 0.10)),
    Post(3.3, -3.2, 0.09, 0.95, (0.55, 0.16, 0.10)),
    Post(-3.3, 1.2, 0.45, 0.60, (0.50, 0.47, 0.42)),
    Post(3.3, 1.2, 0.45, 0.60, (0.50, 0.47, 0.42)),
    Post(-6.5, -5.5, 0.25, 2.60, (0.62, 0.58, 0.50)),
    Post(6.5, -5.5, 0.25, 2.60, (0.62, 0.58, 0.50)),
    Post(-4.5, 6.0, 0.25, 2.60, (0.62, 0.58, 0.50)),
    Post(1.2, 3.6, 0.15, 0.80, (0.14, 0.30, 0.45)),
)


@dataclass(frozen=True)
class Layers:
    """Static parts of the picture, linear light. Colours are (height, width, 3), the rest (height, width)."""

    ambient: Array                  # radiance without the sun
    ground: Array                   # what the sun adds where ground_lit is 1
    objects: Array                  # what the sun adds to posts and facades where object_lit is 1
    normal: Array                   # of posts, (height, width, 3); zero elsewhere
    post: NDArray[np.int8]          # index of the post a pixel shows, -1 for none
    facade: NDArray[np.bool_]       # hills and houses


def directions(width: int, height: int, row: float = 0.5, column: float = 0.5) -> tuple[Array, Array]:
    """Azimuth (width,) and elevation (height,) in radians of the point (row, column) inside each pixel."""
    u = (np.arange(width) + column) / width
    v = (np.arange(height) + row) / height
    return ((u - 0.5) * 2 * np.pi).astype(np.float32), ((0.5 - v) * np.pi).astype(np.float32)


def build_layers(width: int, supersample: int = 2) -> Layers:
    """Render the static place at (width / 2, width), the mean of supersample² samples a pixel."""
    shape = (width // 2, width)
    ambient, ground, objects, normal = (np.zeros((*shape, 3), np.float32) for _ in range(4))
    facade = np.zeros(shape, bool)
    post = np.full(shape, -1, np.int8)
    offsets = (np.arange(supersample) + 0.5) / supersample
    weight = np.float32(1 / supersample**2)
    for row, column in ((row, column) for row in offsets for column in offsets):
        sample = _Sample(*directions(width, width // 2, row, column))
        ambient += sample.ambient * weight
        ground += sample.ground * weight
        objects += sample.objects * weight
        normal += sample.normal
        facade |= sample.facade
        post = np.maximum(post, sample.post)
    normal /= np.maximum(np.linalg.norm(normal, axis=2, keepdims=True), 1e-6)
    grain = np.random.default_rng(3).normal(1.0, 0.03, (*shape, 1)).astype(np.float32)
    return Layers(ambient * np.where(ground > 0, grain, 1), ground * grain, objects, normal, post, facade & (post < 0))


class _Sample:
    """The layers at one point of every pixel, painted from far to near."""

    def __init__(self, azimuth: Array, elevation: Array) -> None:
        self.azimuth, self.elevation = azimuth, elevation
        shape = (len(elevation), len(azimuth))
        self.ambient, self.ground, self.objects, self.normal = (np.zeros((*shape, 3), np.float32) for _ in range(4))
        self.facade = np.zeros(shape, bool)
        self.post = np.full(shape, -1, np.int8)
        self.horizon = int(np.searchsorted(-elevation, 0.0))
        self._paint_sky()
        self._paint_ground()
        self._paint_horizon()
        for index in range(len(POSTS)):
            self._paint_post(index)

    def _paint_sky(self) -> None:
        elevation = self.elevation[: self.horizon, None]
        up, across = np.sin(elevation), np.cos(elevation)
        x, z = across * np.sin(self.azimuth), -across * np.cos(self.azimuth)
        rng = np.random.default_rng(1)
        cloud = np.zeros_like(x)
        for index in range(24):     # waves through the sphere: no seam, no pinch at the zenith
            octave = index // 4
            wave = rng.normal(size=3) * 2.0 * 1.7**octave
            phase = x * wave[0] + 2 * up * wave[1] + z * wave[2] + 0.8 * cloud
            cloud += 0.5 * np.cos(phase + index) / 1.6**octave
        amount = (np.clip(cloud - 0.25, 0, 1.5) / 1.5 * np.clip(up * 4, 0, 1) * 0.75)[..., None]
        haze = np.exp(-3.5 * up)[..., None]
        sky = haze * HAZE + (1 - haze) * ZENITH
        self.ambient[: self.horizon] = sky * (1 - amount) + amount * np.float32(0.62)

    def _paint_ground(self) -> None:
        distance = CAMERA_HEIGHT_M / np.tan(-self.elevation[self.horizon:])
        x = distance[:, None] * np.sin(self.azimuth)
        z = -distance[:, None] * np.cos(self.azimuth)
        albedo = _paving(x, z, distance[:, None])
        contact = np.ones_like(x)
        for post in POSTS:
            gap = np.maximum(np.hypot(x - post.x, z - post.z) - post.radius, 0)
            contact *= 1 - 0.5 * np.exp(-gap / (0.25 * post.height))
        haze = (1 - np.exp(-distance / 120))[:, None, None]
        sunlit = albedo * (1 - haze)
        self.ambient[self.horizon:] = sunlit * contact[..., None] * SKY_AMBIENT + haze * HAZE * 0.7
        self.ground[self.horizon:] = sunlit * SUN_STRENGTH

    def _paint_horizon(self) -> None:
        azimuth, first = self.azimuth, int(np.searchsorted(-self.elevation, -HORIZON_BAND_RAD))
        rows = slice(first, self.horizon)
        elevation = self.elevation[rows, None]
        hill = np.radians(2.6 + 1.3 * np.sin(3 * azimuth + 1) + 0.7 * np.sin(7 * azimuth) + 0.2 * np.sin(23 * azimuth))
        block = np.floor((azimuth / (2 * np.pi) + 0.5) * 48)
        random = np.modf(np.abs(np.sin(block * 12.9898) * 43758.547))[0]
        house = np.where((block % 16 > 3) & (block % 16 < 11), np.radians(3.5 + 6.5 * random), 0)
        is_house = elevation < house
        seen = is_house | (elevation < hill)
        wall = np.stack([0.42 + 0.2 * random, 0.40 + 0.12 * random, 0.40 - 0.08 * random], -1)
        window = (np.modf((azimuth + np.pi) * 60)[0] > 0.55) & (np.modf(elevation * 80)[0] > 0.5)
        grass = np.array([0.16, 0.22, 0.13]) + 0.03 * np.sin(azimuth * 131)[:, None]
        albedo = np.where(is_house[..., None], np.where(window[..., None], 0.1, wall), grass) * seen[..., None]
        self.ambient[rows] = np.where(seen[..., None], albedo * SKY_AMBIENT * 0.8 + HAZE * 0.08, self.ambient[rows])
        self.objects[rows] = albedo * SUN_STRENGTH
        self.facade[rows] = seen

    def _paint_post(self, index: int) -> None:
        post = POSTS[index]
        distance = float(np.hypot(post.x, post.z))
        centre = float(np.arctan2(post.x, -post.z))
        offset = (self.azimuth - centre + np.pi) % (2 * np.pi) - np.pi
        columns = np.nonzero(np.abs(offset) < np.arcsin(post.radius / distance))[0]
        sin_x, cos_x = np.sin(self.azimuth[columns]), -np.cos(self.azimuth[columns])
        middle = distance * np.cos(offset[columns])     # where the ray in plan is nearest to the axis
        half = np.sqrt(np.maximum(post.radius**2 - (distance * np.sin(offset[columns])) ** 2, 0))
        slope = np.tan(self.elevation)[:, None]
        top = post.height - CAMERA_HEIGHT_M
        side_height = slope * (middle - half)
        with np.errstate(divide="ignore"):
            top_reach = top / slope
        on_side = (side_height > -CAMERA_HEIGHT_M) & (side_height < top)
        on_top = (slope < 0) & (top < 0) & (top_reach > middle - half) & (top_reach < middle + half)
        hit_x, hit_z = sin_x * (middle - half), cos_x * (middle - half)
        side = np.stack([(hit_x - post.x) / post.radius, np.zeros_like(hit_x), (hit_z - post.z) / post.radius], -1)
        normal = np.where(on_top[..., None], np.array([0, 1, 0]), side)
        hit = on_side | on_top
        above_ground = np.clip((side_height + CAMERA_HEIGHT_M) / post.height, 0, 1)
        sky_seen = np.where(on_top, 1.0, 0.45 + 0.25 * above_ground)
        rows, picked = np.nonzero(hit)
        where = (rows, columns[picked])
        albedo = np.array(post.albedo, np.float32)
        self.ambient[where] = sky_seen[hit][:, None] * albedo * SKY_AMBIENT
        self.ground[where] = 0
        self.objects[where] = albedo * SUN_STRENGTH
        self.normal[where] = normal[hit]
        self.facade[where] = False
        self.post[where] = index


def _paving(x: Array, z: Array, distance: Array) -> Array:
    """Albedo (..., 3) of slabs 0.6 m wide in running bond; joints and grain fade with distance."""
    row = np.floor(z / 0.6)
    shifted = x / 0.6 + 0.5 * (row % 2)
    column = np.floor(shifted)
    tint = _hash(row, column)
    edge = np.minimum(np.minimum(shifted - column, column + 1 - shifted), np.minimum(z / 0.6 - row, row + 1 - z / 0.6))
    joint = np.clip(1 - (edge - 0.008) / (0.008 + 0.002 * distance), 0, 1) * np.clip(6 / distance, 0, 1)
    speck = _hash(np.floor(x / 0.02), np.floor(z / 0.02)) - 0.5
    value = (0.38 + 0.10 * (tint - 0.5)) * (1 - 0.5 * joint) * (1 + 0.25 * speck * np.clip(3 / distance, 0, 1))
    warm: Array = value[..., None] * np.array([1.06, 1.0, 0.92])
    return warm


def _hash(a: Array, b: Array) -> Array:
    """A number in [0, 1) for every pair of whole numbers."""
    mixed = a.astype(np.int64) * 73856093 ^ b.astype(np.int64) * 19349663
    mixed = (mixed ^ (mixed >> 13)) * 1274126177 & 0x7FFFFFFF
    return (mixed ^ (mixed >> 16)) % 4096 / 4096.0

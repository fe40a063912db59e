"""A synthetic 360 camera: equirectangular frames under a sun whose direction is known for every time stamp.

The sun goes once round the horizon in LOOP_SECONDS at a constant elevation, so the clip loops without a jump. Like a
real camera this one clips: the sun is a disc of all 255 with a narrow glow. Only what the sun moves is redrawn.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from server.demo.landscape import (
    CAMERA_HEIGHT_M,
    HORIZON_BAND_RAD,
    POSTS,
    Array,
    Post,
    build_layers,
    directions,
)

LOOP_SECONDS = 30
STILL_SECONDS = 10
SUN_ELEVATION_RAD = math.radians(38.0)
SUN_START_RAD = math.radians(120.0)     # right and behind; crosses the seam (behind) after 5 s
SUN_RADIUS_RAD = math.radians(2.0)
GLOW_RAD = math.radians(9.0)
NOISE_CODES = 0.7                       # standard deviation of the sensor noise in luma
DIM_NOISE_CODES = 2.1                   # of a sensor in dim light, which fills any bitrate

Planes = tuple[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.uint8]]
Columns = slice | NDArray[np.intp]      # indices where they run across the seam
Window = tuple[slice, Columns]          # rows and columns, both starting and ending at even numbers


def sun_azimuth(pts_seconds: float) -> float:
    """Azimuth of the sun in radians (0 is forward, growing to the right) in the frame shown at `pts_seconds`."""
    return SUN_START_RAD + 2 * math.pi * (pts_seconds % LOOP_SECONDS) / LOOP_SECONDS


def sun_direction(pts_seconds: float) -> tuple[float, float, float]:
    """Unit vector (x, y, z) from the camera to the sun's centre in the frame shown at `pts_seconds`."""
    azimuth, across = sun_azimuth(pts_seconds), math.cos(SUN_ELEVATION_RAD)
    return (across * math.sin(azimuth), math.sin(SUN_ELEVATION_RAD), -across * math.cos(azimuth))


class Camera:
    """Renders frames of width × width / 2 pixels. Raises ValueError if width is no multiple of 4 in 256..8192."""

    def __init__(self, width: int, noise_codes: float = NOISE_CODES) -> None:
        if width % 4 or not 256 <= width <= 8192:
            raise ValueError(f"width is {width}, expected a multiple of 4 from 256 to 8192")
        self.width, self.height = width, width // 2
        self._azimuth, self._elevation = directions(width, self.height)
        self._layers = build_layers(width)
        self._ground_lit = np.full((self.height, width), math.sin(SUN_ELEVATION_RAD), np.float32)
        self._object_lit = np.zeros((self.height, width), np.float32)
        self._lit_now = (self._ground_lit.copy(), self._object_lit.copy())
        self._post_windows = [self._window_of(self._layers.post == index) for index in range(len(POSTS))]
        self._band = self._angles_window(-math.pi, math.pi, 0.0, HORIZON_BAND_RAD)
        self._still = self._converted(slice(0, self.height), slice(0, width))
        rng = np.random.default_rng(5)
        noise = rng.normal(0, noise_codes, (self.height + 64, width + 64)).round()
        self._noise = noise.astype(np.int8)

    def frame(self, pts_seconds: float, sun_seconds: float | None = None) -> Planes:
        """The frame shown at `pts_seconds` as BT.709 limited-range planes Y (h, w), Cb and Cr (h / 2, w / 2).

        With `sun_seconds` the sun stands where it is at that time, and only the noise is that of `pts_seconds`.
        """
        sun_seconds = pts_seconds if sun_seconds is None else sun_seconds
        azimuth = sun_azimuth(sun_seconds)
        sun = np.array(sun_direction(sun_seconds), np.float32)
        ground_lit, object_lit = self._lit_now
        lower = slice(self._band[0].start, self.height)
        ground_lit[lower], object_lit[lower] = self._ground_lit[lower], 0
        windows = [self._band]
        for post, window in zip(POSTS, self._post_windows, strict=True):
            shadow = self._shadow_window(post, azimuth)
            ground_lit[shadow[0], shadow[1]] *= self._sun_seen(post, azimuth, shadow)
            windows += [window, shadow]
        self._light_objects(object_lit, azimuth, sun)
        planes: Planes = (self._still[0].copy(), self._still[1].copy(), self._still[2].copy())
        for window in windows:
            _paste(planes, window, self._converted(*window, ground_lit, object_lit))
        self._add_noise(planes[0], round(pts_seconds % LOOP_SECONDS * 1000))
        window = self._angles_window(azimuth - 1.3 * GLOW_RAD / math.cos(SUN_ELEVATION_RAD),
                                     azimuth + 1.3 * GLOW_RAD / math.cos(SUN_ELEVATION_RAD),
                                     SUN_ELEVATION_RAD - GLOW_RAD, SUN_ELEVATION_RAD + GLOW_RAD)
        _paste(planes, window, _yuv_from_linear(self._layers.ambient[window] + self._glow(sun, window)))
        return planes

    def frames(self, fps: int) -> Iterator[Planes]:
        """One loop, LOOP_SECONDS × fps frames."""
        return (self.frame(index / fps) for index in range(LOOP_SECONDS * fps))

    def still_frames(self, fps: int) -> Iterator[Planes]:
        """STILL_SECONDS × fps frames under a sun that stands still: they differ by the sensor's noise alone."""
        return (self.frame(index / fps, 0.0) for index in range(STILL_SECONDS * fps))

    def _add_noise(self, luma: NDArray[np.uint8], seed: int) -> None:
        row, column = np.random.default_rng(seed).integers(0, 64, 2)
        noise = self._noise[row:row + self.height, column:column + self.width]
        luma += noise.view(np.uint8)    # wraps like two's complement; the picture without the sun stays within 16..235

    def _glow(self, sun: Array, window: Window) -> Array:
        """What the sun adds to the sky (rows, columns, 1): far above 1 inside the disc, then a steep bloom."""
        elevation, azimuth = self._elevation[window[0]][:, None], self._azimuth[window[1]]
        across = np.cos(elevation)
        cosine = across * np.sin(azimuth) * sun[0] + np.sin(elevation) * sun[1] - across * np.cos(azimuth) * sun[2]
        angle = np.arccos(np.clip(cosine, -1, 1))
        outside = np.maximum(angle - SUN_RADIUS_RAD, 0)
        fade = np.clip(1 - angle / GLOW_RAD, 0, 1) ** 2
        bloom = (0.45 * np.exp(-outside / math.radians(0.6)) + 0.25) * fade
        pixel = math.pi / self.height
        disc = np.clip((SUN_RADIUS_RAD - angle) / pixel + 0.5, 0, 1)    # antialiased edge
        glow: Array = (bloom + 4 * disc)[..., None].astype(np.float32)
        return glow

    def _light_objects(self, object_lit: Array, azimuth: float, sun: Array) -> None:
        facing = np.maximum(-np.cos(self._azimuth - azimuth), 0) * math.cos(SUN_ELEVATION_RAD)
        facade = self._layers.facade[self._band]
        object_lit[self._band] = facade * (0.15 + facing)
        for index, window in enumerate(self._post_windows):
            towards = np.maximum(self._layers.normal[window] @ sun, 0)
            mine = self._layers.post[window] == index
            object_lit[window] = np.where(mine, towards, object_lit[window])

    def _sun_seen(self, post: Post, azimuth: float, window: Window) -> Array:
        """Fraction of the sun that the ground sees past a post, (rows, columns): product of two penumbrae."""
        distance = CAMERA_HEIGHT_M / np.tan(np.maximum(-self._elevation[window[0]], 1e-4))[:, None]
        x = distance * np.sin(self._azimuth[window[1]]) - post.x
        z = -distance * np.cos(self._azimuth[window[1]]) - post.z
        along = -x * math.sin(azimuth) + z * math.cos(azimuth)      # metres from the axis, away from the sun
        aside = np.abs(x * math.cos(azimuth) + z * math.sin(azimuth))
        chord = np.sqrt(np.maximum(post.radius**2 - aside**2, 0))
        reach = np.maximum(along - chord, 1e-3)                     # in plan, to where the sun's ray enters the post
        half_width = reach / math.cos(SUN_ELEVATION_RAD) * math.tan(SUN_RADIUS_RAD)
        sideways = _step((post.radius - aside) / half_width) - _step((-post.radius - aside) / half_width)
        low = reach * math.tan(SUN_ELEVATION_RAD - SUN_RADIUS_RAD)
        high = reach * math.tan(SUN_ELEVATION_RAD + SUN_RADIUS_RAD)
        under_top = _step((2 * post.height - low - high) / np.maximum(high - low, 1e-6))
        seen: Array = (1 - sideways * under_top * (along + chord > 0)).astype(np.float32)
        return seen

    def _shadow_window(self, post: Post, azimuth: float) -> Window:
        length = post.height / math.tan(SUN_ELEVATION_RAD - SUN_RADIUS_RAD)
        radius = post.radius + 0.05 * length + 0.02
        along = np.linspace(0, length, 24)[:, None]
        angle = np.linspace(0, 2 * np.pi, 24)
        x = post.x - along * math.sin(azimuth) + radius * np.cos(angle)
        z = post.z + along * math.cos(azimuth) + radius * np.sin(angle)
        centre = math.atan2(post.x, -post.z)
        offset = (np.arctan2(x, -z) - centre + np.pi) % (2 * np.pi) - np.pi
        elevation = -np.arctan2(CAMERA_HEIGHT_M, np.hypot(x, z))
        return self._angles_window(centre + offset.min(), centre + offset.max(), elevation.min(),
                                   min(elevation.max(), -math.pi / self.height))

    def _angles_window(self, left: float, right: float, low: float, high: float) -> Window:
        first = math.floor((left / (2 * math.pi) + 0.5) * self.width) // 2 * 2
        last = math.ceil((right / (2 * math.pi) + 0.5) * self.width + 1) // 2 * 2
        top = max(math.floor((0.5 - high / math.pi) * self.height) // 2 * 2, 0)
        bottom = min(math.ceil((0.5 - low / math.pi) * self.height + 1) // 2 * 2, self.height)
        if last - first >= self.width:
            return slice(top, bottom), slice(0, self.width)
        if first >= 0 and last <= self.width:
            return slice(top, bottom), slice(first, last)
        return slice(top, bottom), np.arange(first, last) % self.width

    def _window_of(self, mask: NDArray[np.bool_]) -> Window:
        rows, columns = np.nonzero(mask.any(1))[0], np.nonzero(mask.any(0))[0]
        top, bottom = int(rows[0]) // 2 * 2, int(rows[-1]) // 2 * 2 + 2
        left, right = int(columns[0]) // 2 * 2, int(columns[-1]) // 2 * 2 + 2
        return slice(top, bottom), slice(left, right)

    def _converted(self, rows: slice, columns: Columns, ground_lit: Array | None = None,
                   object_lit: Array | None = None) -> Planes:
        window = (rows, columns)
        lit = (self._ground_lit if ground_lit is None else ground_lit)[window][..., None]
        shining = (self._object_lit if object_lit is None else object_lit)[window][..., None]
        layers = self._layers
        return _yuv_from_linear(layers.ambient[window] + layers.ground[window] * lit + layers.objects[window] * shining)


def _step(x: Array) -> Array:
    """Fraction of a disc of radius 1 that lies left of a straight edge at x, as a smoothstep: 0 at -1, 1 at 1."""
    t = np.clip(0.5 + 0.5 * x, 0, 1)
    fraction: Array = t * t * (3 - 2 * t)
    return fraction


def _srgb_table() -> Array:
    linear = np.arange(4096) / 4095
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055).astype(np.float32)


_SRGB = _srgb_table()


def _yuv_from_linear(rgb: Array) -> Planes:
    """Clip, sRGB transfer, BT.709 limited range, chroma the mean of 2×2. Height and width of `rgb` are even."""
    code = _SRGB[np.clip(rgb * 4095 + 0.5, 0, 4095).astype(np.int16)]
    red, green, blue = code[..., 0], code[..., 1], code[..., 2]
    luma = 0.2126 * red + 0.7152 * green + 0.0722 * blue
    cb, cr = (_halved((colour - luma) * scale) for colour, scale in ((blue, 224 / 1.8556), (red, 224 / 1.5748)))
    return ((16.5 + 219 * luma).astype(np.uint8), (128.5 + cb).astype(np.uint8), (128.5 + cr).astype(np.uint8))


def _halved(plane: Array) -> Array:
    return (plane[::2, ::2] + plane[1::2, ::2] + plane[::2, 1::2] + plane[1::2, 1::2]) * np.float32(0.25)


def _paste(planes: Planes, window: Window, pixels: Planes) -> None:
    rows, columns = window
    planes[0][rows, columns] = pixels[0]
    half_rows = slice(rows.start // 2, rows.stop // 2)
    half_columns: Columns = (slice(columns.start // 2, columns.stop // 2) if isinstance(columns, slice)
                             else columns[::2] // 2)
    planes[1][half_rows, half_columns] = pixels[1]
    planes[2][half_rows, half_columns] = pixels[2]

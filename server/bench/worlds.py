"""Worlds whose light is known: a smooth sky as a function of direction, and lamps as discs of exact direction, size and power."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from renderer.equirectangular import pixel_directions, solid_angles
from renderer.light.detection import Light
from server.bench.frames import direction

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
SUBSAMPLES = 8      # a side of a pixel at the edge of a disc
MIDDLE_GREY = 0.2   # linear display light of the median, as a camera exposes


@dataclass(frozen=True)
class World:
    """`sky`: (height, width, 3) radiance without the lights; `radiance`: with them; `exposure`: of its camera."""

    name: str
    sky: Array
    radiance: Array32
    lights: tuple[Light, ...]

    @cached_property
    def exposure(self) -> float:
        """Display light (linear) by radiance."""
        return MIDDLE_GREY / float(np.median(self.sky.mean(axis=2)))

    @cached_property
    def shown(self) -> Array:
        """(height, width, 3) linear display light in its camera's picture, clipped at white."""
        return np.minimum(self.exposure * self.radiance.astype(np.float64), 1.0)


def lamp(azimuth_deg: float, elevation_deg: float, radius_deg: float, irradiance: float,
         tint: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> Light:
    return Light(direction(azimuth_deg, elevation_deg), irradiance * np.array(tint), float(np.radians(radius_deg)))


def world(name: str, sky: Callable[[Array], Array], lights: tuple[Light, ...], size: tuple[int, int]) -> World:
    """`sky`: of (..., 3) directions, (...) or (..., 3) radiance. A disc's edge is true to the area, its power exact."""
    width, height = size
    smooth = sky(pixel_directions(height, width))
    smooth = np.repeat(smooth[..., None], 3, axis=2) if smooth.ndim == 2 else smooth
    radiance = smooth.copy()
    for light in lights:
        radiance += disc_coverage(light, size)[..., None] * (light.irradiance / (np.pi * np.sin(light.angular_radius) ** 2))
    return World(name, smooth, radiance.astype(np.float32), lights)


def disc_coverage(light: Light, size: tuple[int, int]) -> Array:
    """(height, width) share of each pixel that a disc covers; all of them together have exactly its solid angle."""
    width, height = size
    directions = pixel_directions(height, width)
    near = np.flatnonzero((directions @ light.direction > np.cos(light.angular_radius + 1.5 * np.pi / height)).ravel())
    rows, columns = near // width, near % width
    offsets = (np.arange(SUBSAMPLES) + 0.5) / SUBSAMPLES
    polar = (rows[:, None, None] + offsets[:, None]) / height * np.pi
    azimuth = ((columns[:, None, None] + offsets) / width - 0.5) * 2 * np.pi
    x, y, z = np.broadcast_arrays(np.sin(polar) * np.sin(azimuth), np.cos(polar), -np.sin(polar) * np.cos(azimuth))
    inside = np.stack([x, y, z], axis=-1) @ light.direction > np.cos(light.angular_radius)
    flat = np.zeros(width * height)
    flat[near] = (inside * np.sin(polar)).sum(axis=(1, 2)) / np.broadcast_to(np.sin(polar), inside.shape).sum(axis=(1, 2))
    covered = flat.reshape(height, width)
    return np.asarray(covered * (light.solid_angle / float((covered * solid_angles(height, width)).sum())))


def clear_sky(d: Array) -> Array:
    up = np.clip(d[..., 1:2], 0.0, 1.0) ** 0.6
    return np.where(d[..., 1:2] >= 0, (1 - up) * [0.9, 0.92, 0.95] + up * [0.25, 0.42, 0.75], [0.34, 0.3, 0.24])


def overcast_sky(d: Array) -> Array:
    """The CIE's standard overcast sky, a third brighter to one side, over a grey ground."""
    return np.where(d[..., 1] >= 0, (1 + 2 * np.maximum(d[..., 1], 0.0)) / 3 * (1 + 0.15 * d[..., 0]), 0.22)


def walls(d: Array) -> Array:
    """A grey room with a lighter ceiling and a wide bright window."""
    window = 1 / (1 + np.exp(-60 * (d @ direction(-110, 15) - np.cos(np.radians(24)))))
    return np.asarray(0.25 + 0.15 * d[..., 1] + 2.0 * window)


def night(d: Array) -> Array:
    return np.asarray(0.03 + 0.02 * d[..., 1])


def worlds(size: tuple[int, int], names: tuple[str, ...] = ("sun", "overcast", "room", "lamps")) -> list[World]:
    """`sun`: a clear sky; `overcast`: no light at all; `room`: two lamps and a window; `lamps`: five at night, one on the seam."""
    known: dict[str, tuple[Callable[[Array], Array], tuple[Light, ...]]] = {
        "sun": (clear_sky, (lamp(50, 40, 0.6, 5.0, (1.0, 0.95, 0.85)),)),
        "overcast": (overcast_sky, ()),
        "room": (walls, (lamp(60, 55, 4.0, 1.2), lamp(-20, 70, 6.0, 0.9))),
        "lamps": (night, (lamp(180, 30, 1.5, 0.5), lamp(70, 50, 2.0, 0.7, (1.0, 0.8, 0.5)), lamp(-60, 20, 1.0, 0.35),
                          lamp(20, 84, 3.0, 0.4), lamp(-130, 45, 2.5, 0.55))),
    }
    return [world(name, *known[name], size) for name in names]

"""Radiance maps with closed forms, and what light they give by direct summation in float64."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from renderer.equirectangular import pixel_directions, solid_angles, uv_from_direction
from renderer.frame import RadianceFrame
from renderer.light.inverse_tone_mapping import MAX_RADIANCE
from renderer.light.irradiance import basis, disc_cosine
from renderer.light.radiance_map import map_size
from renderer.light.reading import FrameLight
from renderer.light.specular import ggx_lobe, resample
from server.worker.images import RADIANCE_SUFFIXES, read_still

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
SIZE = (512, 256)
NORMALS = 2000
SUMMED_ROWS = 256


def given_maps(folder: Path | None) -> Iterator[tuple[str, Array32]]:
    """Every `.exr` and `.hdr` of a folder, by name."""
    for path in sorted(folder.iterdir()) if folder is not None else []:
        if path.suffix in RADIANCE_SUFFIXES:
            frame = read_still(path)
            assert isinstance(frame, RadianceFrame)
            yield path.name, frame.rgb


def analytic_maps() -> Iterator[tuple[str, Array32]]:
    """Maps whose irradiance has a closed form; `reference_irradiance` gives it by quadrature all the same."""
    d = pixel_directions(SIZE[1], SIZE[0])
    towards = np.array([0.48, 0.6, -0.64])
    grey = {
        "constant": np.full(d.shape[:2], 0.7), "cosine lobe": np.maximum(d @ towards, 0.0),
        "hemisphere": (d[..., 1] > 0).astype(float), "harmonic 2,0": 1.0 + basis(d)[..., 6],
        "disc of 0.5 degrees": np.where(d @ towards > np.cos(np.radians(0.5)), 2e4, 0.3),
        "disc of 5 degrees": np.where(d @ towards > np.cos(np.radians(5)), 200.0, 0.3),
        "disc of 20 degrees": np.where(d @ towards > np.cos(np.radians(20)), 10.0, 0.3),
    }
    for name, values in grey.items():
        yield name, np.repeat(values[..., None], 3, axis=2).astype(np.float32)


def reduced(radiance: Array32) -> Array:
    """The map at the size at which lights are looked for."""
    width, height = map_size((radiance.shape[1], radiance.shape[0]))
    return np.asarray(resample(clean(radiance), height, width), dtype=np.float64)


def clean(radiance: Array32) -> Array:
    """What passes the renderer's door."""
    return np.minimum(radiance.astype(np.float64), MAX_RADIANCE)


def random_normals(count: int = NORMALS) -> Array:
    points = np.random.default_rng(1).normal(size=(count, 3))
    return np.asarray(points / np.linalg.norm(points, axis=1, keepdims=True))


def reference_irradiance(radiance: Array32, normals: Array) -> Array:
    """(n, 3) irradiance by direct summation over every texel."""
    height, width = radiance.shape[:2]
    directions = pixel_directions(height, width)
    power = clean(radiance) * solid_angles(height, width)[..., None]
    total = np.zeros((len(normals), 3))
    for row in range(height):
        total += np.maximum(normals @ directions[row].T, 0.0) @ power[row]
    return total


def summed_irradiance(radiance: NDArray[np.floating], normals: Array) -> Array:
    """The same over the texels of a map of at most SUMMED_ROWS rows that has the same power."""
    rows = min(radiance.shape[0], SUMMED_ROWS)
    return reference_irradiance(np.asarray(resample(radiance, rows, 2 * rows), dtype=np.float32), normals)


def light_irradiance(light: FrameLight, normals: Array) -> Array:
    """(n, 3) irradiance on these normals as the renderer shades it: the interpolated irradiance map, and the lights."""
    found = interpolated(light.irradiance.astype(np.float64), normals)
    for item in light.detection.lights:
        if not item.is_wide:
            found += disc_cosine(normals @ item.direction, item.angular_radius)[:, None] * item.irradiance
    return found


def interpolated(values: Array, directions: Array) -> Array:
    """Bilinear look-up across the seam and the poles."""
    rows, columns = values.shape[:2]
    grid = np.zeros((rows + 2, columns + 2, 3))
    grid[1:-1, 1:-1] = values
    grid[0, 1:-1], grid[-1, 1:-1] = np.roll(values[0], columns // 2, axis=0), np.roll(values[-1], columns // 2, axis=0)
    grid[:, 0], grid[:, -1] = grid[:, -2], grid[:, 1]
    at = uv_from_direction(directions) * (columns, rows) + 0.5
    corner = np.floor(at).astype(int)
    x, y = corner[:, 0], corner[:, 1]
    fx, fy = ((at - corner)[:, axis, None] for axis in (0, 1))
    return np.asarray((1 - fy) * ((1 - fx) * grid[y, x] + fx * grid[y, x + 1])
                      + fy * ((1 - fx) * grid[y + 1, x] + fx * grid[y + 1, x + 1]))


def kernel_glossy(radiance: Array, directions: Array, roughness: float) -> Array:
    """(n, 3) radiance as a GGX lobe with N = V = R sees it around each direction."""
    return weighted_mean(radiance, lambda towards: ggx_lobe(np.clip(directions @ towards.T, -1, 1), roughness))


def reflected_glossy(radiance: Array, normals: Array, views: Array, roughness: float) -> Array:
    """(n, 3) radiance that a white GGX surface with energy compensation sends to the viewer: a weighted mean of the map."""
    alpha2 = max(roughness**4, 1e-8)
    n_dot_v = (normals * views).sum(axis=1)[:, None]

    def weight(towards: Array) -> Array:
        n_dot_l = np.maximum(normals @ towards.T, 0.0)
        v_dot_l = views @ towards.T
        n_dot_h = (n_dot_l + n_dot_v) / np.sqrt(np.maximum(2 + 2 * v_dot_l, 1e-12))
        distribution = alpha2 / (n_dot_h**2 * (alpha2 - 1) + 1) ** 2
        visibility = 1 / (n_dot_l * np.sqrt(n_dot_v**2 * (1 - alpha2) + alpha2)
                          + n_dot_v * np.sqrt(n_dot_l**2 * (1 - alpha2) + alpha2))
        return np.asarray(distribution * visibility * n_dot_l)

    return weighted_mean(radiance, weight)


def weighted_mean(radiance: Array, weight: Callable[[Array], NDArray[np.floating]]) -> Array:
    """(n, 3) mean of a map by `weight`, of (columns, 3) directions to (n, columns), times solid angle."""
    height, width = radiance.shape[:2]
    directions, area = pixel_directions(height, width), solid_angles(height, width)
    total, norm = np.zeros(1), np.zeros(1)
    for row in range(height):
        weights = weight(directions[row]) * area[row, 0]
        total, norm = total + weights @ radiance[row], norm + weights.sum(axis=1, keepdims=True)
    return np.asarray(total / norm)

"""`make bench-light`: the light stages against closed forms and float64 references, one row a map.

`python -m server.bench.light [FOLDER]` takes the analytic maps, and every `.exr` and `.hdr` of the folder besides.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from renderer.equirectangular import pixel_directions, solid_angles, uv_from_direction
from renderer.frame import RadianceFrame
from renderer.gl import Context
from renderer.inverse_tone_mapping import MAX_RADIANCE, WEIGHTS
from renderer.irradiance import basis, disc_cosine
from renderer.light_detection import find_candidates
from renderer.light_reading import FrameLight
from renderer.light_tracking import LightTracker
from renderer.pipeline import Pipeline
from renderer.radiance_map import RadianceMap, map_size
from renderer.specular import resample
from server.worker.images import RADIANCE_SUFFIXES, read_still

Array = NDArray[np.float64]
SIZE = (512, 256)
NORMALS = 2000
REPEATS = 50


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m server.bench.light", description=__doc__)
    parser.add_argument("folder", type=Path, nargs="?", help="radiance maps to measure besides the analytic ones")
    context = Context()
    print(f"{'map':28}{'lights':>7}{'E rms %':>9}{'E max %':>9}{'bias %':>8}{'energy':>10}{'detect ms':>11}")
    for name, radiance in _maps(parser.parse_args().folder):
        print(_row(context, name, radiance), flush=True)
    context.release()
    return 0


def _maps(folder: Path | None) -> Iterator[tuple[str, NDArray[np.float32]]]:
    yield from analytic_maps()
    for path in sorted(folder.iterdir()) if folder is not None else []:
        if path.suffix in RADIANCE_SUFFIXES:
            frame = read_still(path)
            assert isinstance(frame, RadianceFrame)
            yield path.name, frame.rgb


def analytic_maps() -> Iterator[tuple[str, NDArray[np.float32]]]:
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


def irradiance_errors(context: Context, radiance: NDArray[np.float32]) -> tuple[FrameLight, Array]:
    """The light that is read from a map, and its (n, 3) errors of irradiance in units of the reference's rms."""
    pipeline = Pipeline(context, RadianceFrame, (radiance.shape[1], radiance.shape[0]))
    light, _ = pipeline.analyse(RadianceFrame(radiance))
    pipeline.release()
    normals = _normals()
    expected = reference_irradiance(radiance, normals)
    return light, (light_irradiance(light, normals) - expected) / np.sqrt((expected**2).mean())


def _row(context: Context, name: str, radiance: NDArray[np.float32]) -> str:
    light, errors = irradiance_errors(context, radiance)
    rgb = light.detection.residual
    power = float((rgb @ WEIGHTS * solid_angles(*rgb.shape[:2])).sum())
    whole = float((np.minimum(radiance.astype(np.float64), MAX_RADIANCE) @ WEIGHTS * solid_angles(*radiance.shape[:2])).sum())
    taken = sum(float(item.irradiance @ WEIGHTS) for item in light.detection.lights)
    return (f"{name:28}{len(light.detection.lights):7}{100 * np.sqrt((errors**2).mean()):9.2f}{100 * np.abs(errors).max():9.2f}"
            f"{100 * errors.mean():8.2f}{(power + taken) / whole - 1:10.1e}{_milliseconds(_reduced(radiance)):11.2f}")


def light_irradiance(light: FrameLight, normals: Array) -> Array:
    """(n, 3) irradiance on these normals as the renderer shades it: the interpolated irradiance map, and the lights."""
    found = _interpolated(light.irradiance.astype(np.float64), normals)
    for item in light.detection.lights:
        if not item.is_wide:
            found += disc_cosine(normals @ item.direction, item.angular_radius)[:, None] * item.irradiance
    return found


def _interpolated(values: Array, directions: Array) -> Array:
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


def reference_irradiance(radiance: NDArray[np.float32], normals: Array) -> Array:
    """(n, 3) irradiance by direct summation over every texel, in float64."""
    height, width = radiance.shape[:2]
    directions = pixel_directions(height, width)
    clean = np.minimum(radiance.astype(np.float64), MAX_RADIANCE) * solid_angles(height, width)[..., None]
    total = np.zeros((len(normals), 3))
    for row in range(height):
        total += np.maximum(normals @ directions[row].T, 0.0) @ clean[row]
    return total


def _reduced(radiance: NDArray[np.float32]) -> Array:
    """The map at the size at which lights are looked for."""
    width, height = map_size((radiance.shape[1], radiance.shape[0]))
    return np.asarray(resample(np.minimum(radiance.astype(np.float64), MAX_RADIANCE), height, width), dtype=np.float64)


def _normals() -> Array:
    points = np.random.default_rng(1).normal(size=(NORMALS, 3))
    return np.asarray(points / np.linalg.norm(points, axis=1, keepdims=True))


def _milliseconds(rgb: Array) -> float:
    """Median time to find and follow the lights of a map."""
    given, tracker, times = RadianceMap(rgb, np.zeros(rgb.shape[:2])), LightTracker(), []
    for _ in range(REPEATS):
        start = time.perf_counter()
        tracker.update(find_candidates(given))
        times.append(time.perf_counter() - start)
    return float(np.median(times)) * 1e3


if __name__ == "__main__":
    sys.exit(main())

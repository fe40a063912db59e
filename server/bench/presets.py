"""`make bench-presets MAPS=FOLDER`: both presets on every radiance map of a folder, error and time side by side.

Irradiance over the sphere of normals against summation of the whole map; the picture of two balls on the ground
(`whole_scene.py`) against its float64 reference under the same map; and what a live frame of a turning world costs: read and
prepare the light, then render.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from renderer.equirectangular import pixel_directions, solid_angles
from renderer.frame import RadianceFrame
from renderer.gl import Context
from renderer.light.detection import Light
from renderer.light.inverse_tone_mapping import WEIGHTS
from renderer.light.specular import resample
from renderer.scene import Lighting
from server.bench.light_reference import clean, given_maps, light_irradiance, random_normals, summed_irradiance
from server.bench.light_tables import rms
from server.bench.pipelines import Pipelines
from server.bench.rows import relative
from server.bench.whole_rows import by_region, displayed, live_times, rendered
from server.bench.whole_scene import environment, looked_at, true_radiance
from server.bench.worlds import World

Array = NDArray[np.float64]
SIZE = (1024, 512)
FRAMES, PIXELS, TEXELS, NORMALS = 120, 160, 96, 1000
LIGHT_ROWS = 256            # of the map whose brightest texels are summed one by one
MOST_LIGHTS = 48
LEAST_SHARE = 2e-3          # of the map's power
PRESETS = ("default", "paper")


@dataclass(frozen=True)
class Outcome:
    """Relative rms errors of irradiance, of the picture from the map and from its 8 bit picture; milliseconds a frame."""

    irradiance: float
    picture: float
    camera: float
    ms_p50: float
    ms_p95: float

    def beats(self, other: Outcome) -> bool:
        """Less error from the map and less time, in each figure."""
        return (self.irradiance < other.irradiance and self.picture < other.picture and self.ms_p50 < other.ms_p50
                and self.ms_p95 < other.ms_p95)

    def columns(self) -> str:
        errors = f"{100 * self.irradiance:9.2f}{100 * self.picture:9.2f}{100 * self.camera:9.1f}"
        return f"{errors}{self.ms_p50:9.1f}{self.ms_p95:9.1f}"


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m server.bench.presets", description=__doc__)
    parser.add_argument("--maps", metavar="FOLDER", type=Path, required=True, help="radiance maps, .exr or .hdr")
    parser.add_argument("--frames", metavar="N", type=int, default=FRAMES, help=f"timed frames a map and preset, default {FRAMES}")
    arguments = parser.parse_args()
    if not arguments.maps.is_dir():
        parser.error(f"maps {str(arguments.maps)!r}, expected a folder")
    context = Context()
    pipelines = Pipelines(context)
    for line in preset_table(pipelines, arguments.maps, arguments.frames):
        print(line, flush=True)
    pipelines.release()
    context.release()
    return 0


def preset_table(pipelines: Pipelines, folder: Path, frames: int, pixels: int = PIXELS, texels: int = TEXELS) -> Iterator[str]:
    yield ("both presets by map: relative rms of irradiance, of the picture from the map, of that from its 8 bit picture, %; "
           f"milliseconds a live frame of {SIZE[0]}x{SIZE[1]}, {frames} frames")
    heads = "".join(f"{name:>9}" for name in ("irrad.", "picture", "camera", "p50", "p95"))
    yield f"{'map':26} |{'default':^45} |{'paper':^45} | default has less error"
    yield f"{'':26} |{heads} |{heads} | and less time"
    verdicts = []
    for name, radiance in given_maps(folder):
        outcomes = compared(pipelines, world_of(name, radiance), frames, pixels, texels)
        verdicts.append(outcomes["default"].beats(outcomes["paper"]))
        yield f"{name:26} |{outcomes['default'].columns()} |{outcomes['paper'].columns()} | {'yes' if verdicts[-1] else 'no'}"
    yield f"{sum(verdicts)} of {len(verdicts)} maps"


def compared(pipelines: Pipelines, world: World, frames: int, pixels: int, texels: int) -> dict[str, Outcome]:
    """By preset."""
    chosen = looked_at(SIZE, pixels)
    background = world.radiance.reshape(-1, 3).astype(np.float64)
    truth = true_radiance(environment(world.sky, world.lights, world.sky), chosen, background, texels)
    normals = random_normals(NORMALS)
    expected = summed_irradiance(world.radiance, normals)
    outcomes = {}
    for preset in PRESETS:
        lighting = Lighting.model_validate({"preset": preset})
        light = pipelines.light(RadianceFrame(world.radiance), lighting)
        picture = by_region(rendered(pipelines, world, lighting, chosen, "radiance"), truth)
        camera = by_region(rendered(pipelines, world, lighting, chosen, "camera"), displayed(truth, world))
        times = live_times(pipelines, world, lighting, frames)
        p50, p95 = np.percentile(times, [50, 95])
        irradiance = relative(light_irradiance(light, normals), expected)
        outcomes[preset] = Outcome(rms(irradiance), rms(picture), rms(camera), float(p50), float(p95))
    return outcomes


def world_of(name: str, radiance: NDArray[np.float32]) -> World:
    """A map at SIZE; its brightest texels above the horizon are lights of their own size, whose direction the reference sees."""
    fine = clean(radiance)
    if fine.shape[0] > SIZE[1]:
        fine = np.asarray(resample(fine, SIZE[1], SIZE[0]), dtype=np.float64)
    elif fine.shape[:2] != SIZE[::-1]:
        fine = _enlarged(fine)
    sky = np.asarray(resample(fine, LIGHT_ROWS, 2 * LIGHT_ROWS), dtype=np.float64)
    lights, flat = [], sky.reshape(-1, 3)
    directions = pixel_directions(LIGHT_ROWS, 2 * LIGHT_ROWS).reshape(-1, 3)
    angles = np.broadcast_to(solid_angles(LIGHT_ROWS, 2 * LIGHT_ROWS), sky.shape[:2]).ravel()
    power = flat @ WEIGHTS * angles
    usual = float(np.median(flat @ WEIGHTS))
    for texel in np.argsort(-power)[:MOST_LIGHTS]:
        radius = float(np.sqrt(angles[texel] / np.pi))
        if power[texel] > LEAST_SHARE * power.sum() and directions[texel, 1] > 2 * radius:
            left = flat[texel] * min(1.0, usual / float(flat[texel] @ WEIGHTS))
            lights.append(Light(directions[texel], (flat[texel] - left) * angles[texel], radius))
            flat[texel] = left
    return World(name, sky, fine.astype(np.float32), tuple(lights))


def _enlarged(radiance: Array) -> Array:
    """Nearest pixels: what a map of fewer pixels is at SIZE."""
    rows, columns = (np.arange(wanted) * given // wanted for wanted, given in zip(SIZE[::-1], radiance.shape[:2], strict=True))
    return np.asarray(radiance[rows][:, columns])


if __name__ == "__main__":
    sys.exit(main())

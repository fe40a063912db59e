"""The tables of `make bench-light`, one function each: what the light stages err and cost, the papers' methods beside ours."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from functools import partial

import numpy as np
from numpy.typing import NDArray

from renderer.equirectangular import pixel_directions, solid_angles
from renderer.frame import RadianceFrame
from renderer.light.detection import Detection, find_candidates
from renderer.light.diffuse import diffuse_map
from renderer.light.fitting import Probe, ProbeFit, probe_irradiance
from renderer.light.inverse_tone_mapping import WEIGHTS
from renderer.light.irradiance import project
from renderer.light.radiance_map import RadianceMap
from renderer.light.reading import FrameLight
from renderer.light.specular import prefilter, resample
from renderer.light.threshold_detection import HEIGHT, WIDTH, detect_by_threshold
from renderer.light.tracking import LightTracker
from renderer.scene import Lighting, Scene
from server.bench.light_reference import (
    clean,
    interpolated,
    kernel_glossy,
    light_irradiance,
    random_normals,
    reduced,
    reference_irradiance,
    reflected_glossy,
)
from server.bench.pipelines import Pipelines

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
Maps = Iterable[tuple[str, Array32]]
REPEATS = 50
ROUGHNESSES = (0.2, 0.35, 0.5, 0.8, 1.0)
PAPERS = Lighting(lights="threshold", diffuse="map32x16", glossy="rings36")
DIFFUSE_METHODS = ("auto", "sh", "convolution", "map16x8", "map32x16", "map128x64")
BALL_DISTANCE, BALL_RADIUS = 2.0, 0.95
FINER = 4


def irradiance_errors(pipelines: Pipelines, radiance: Array32, lighting: Lighting | None = None) -> tuple[FrameLight, Array]:
    """The light that is read from a map, and its (n, 3) errors of irradiance in units of the reference's rms."""
    light = pipelines.light(RadianceFrame(radiance), lighting)
    normals = random_normals()
    expected = reference_irradiance(radiance, normals)
    return light, (light_irradiance(light, normals) - expected) / max(rms(expected), 1e-300)


def irradiance_table(pipelines: Pipelines, maps: Maps) -> Iterator[str]:
    """Over the sphere of normals, lights included; the whole way of the papers beside ours."""
    yield "irradiance over 2000 normals, % of its rms; energy: vector irradiance of lights and residual against the map's"
    yield f"{'map':26}{'lights':>7}{'rms':>7}{'max':>7}{'bias':>7}{'energy':>10} |{'papers: lights':>15}{'rms':>7}{'max':>8}"
    for name, radiance in maps:
        light, errors = irradiance_errors(pipelines, radiance)
        theirs, lost = irradiance_errors(pipelines, radiance, PAPERS)
        yield (f"{name:26}{len(light.detection.lights):7}{100 * rms(errors):7.2f}{100 * np.abs(errors).max():7.2f}"
               f"{100 * errors.mean():7.2f}{_energy_error(reduced(radiance)):10.1e} |{len(theirs.detection.lights):15}"
               f"{100 * rms(lost):7.1f}{100 * np.abs(lost).max():8.1f}")


def _energy_error(radiance: Array) -> float:
    """Of the vector irradiance of the luminance, relative to the map's power."""
    found = LightTracker().update(find_candidates(_as_map(radiance)))
    weights = solid_angles(*radiance.shape[:2])[..., None] * pixel_directions(*radiance.shape[:2])
    left = (((radiance - found.residual) @ WEIGHTS)[..., None] * weights).sum(axis=(0, 1))
    taken = sum((float(item.irradiance @ WEIGHTS) * item.direction for item in found.lights), np.zeros(3))
    return float(np.linalg.norm(left - taken) / max(float((radiance @ WEIGHTS * solid_angles(*radiance.shape[:2])).sum()), 1e-300))


def diffuse_table(pipelines: Pipelines, maps: Maps) -> Iterator[str]:
    """Each method on the same residual, without its lights: what the stage itself errs and costs."""
    yield "diffuse methods on the residual, rms % / milliseconds"
    yield f"{'map':26}" + "".join(f"{method:>16}" for method in DIFFUSE_METHODS)
    normals = random_normals()
    for name, radiance in maps:
        soft = pipelines.light(RadianceFrame(radiance)).soft
        expected = reference_irradiance(soft, normals)
        row = f"{name:26}"
        for method in DIFFUSE_METHODS:
            found = interpolated(diffuse_map(method, soft, project(soft)).astype(np.float64), normals)
            cost = milliseconds(partial(_diffuse, method, soft), 20)
            row += f"{100 * rms(found - expected) / max(rms(expected), 1e-300):9.2f} /{cost:5.2f}"
        yield row


def glossy_table(pipelines: Pipelines, maps: Maps) -> Iterator[str]:
    """The prefiltered maps against their kernel; a white ball in the frame against its whole reflection integral."""
    yield "glossy, rms %: prefiltered residual against the GGX kernel by quadrature | a white ball, ours | the papers' rings"
    yield f"{'map':26}" + 3 * (" |" + "".join(f"{roughness:6.2f}" for roughness in ROUGHNESSES))
    for name, radiance in maps:
        soft = pipelines.light(RadianceFrame(radiance)).soft
        kernel = [100 * _kernel_error(soft, roughness) for roughness in ROUGHNESSES]
        balls = [[100 * _ball_error(pipelines, radiance, roughness, lighting) for roughness in ROUGHNESSES]
                 for lighting in (Lighting(), PAPERS)]
        yield f"{name:26}" + "".join(" |" + "".join(f"{error:6.1f}" for error in errors) for errors in (kernel, *balls))


def _kernel_error(soft: Array32, roughness: float) -> float:
    directions = random_normals(200)
    fine = soft.astype(np.float64).repeat(FINER, axis=0).repeat(FINER, axis=1)      # a lobe may be narrower than a texel
    expected = kernel_glossy(fine, directions, roughness)
    found = interpolated(prefilter(soft, roughness).astype(np.float64), directions)
    return rms(found - expected) / max(rms(expected), 1e-300)


def _ball_error(pipelines: Pipelines, radiance: Array32, roughness: float, lighting: Lighting) -> float:
    frame = RadianceFrame(radiance)
    ball = {"id": "ball", "mesh": "sphere", "position": [0, 0, -BALL_DISTANCE], "scale": [2 * BALL_RADIUS] * 3,
            "material": {"base_color": [1, 1, 1], "metallic": 1, "roughness": roughness}}
    scene = Scene.model_validate({"objects": [ball], "ground": {"catcher": False}}).model_copy(update={"lighting": lighting})
    found = pipelines.of(frame).render(frame, scene).frame
    assert isinstance(found, RadianceFrame)
    rows, columns, normals, views = _ball_pixels(radiance.shape[0], radiance.shape[1])
    expected = reflected_glossy(_fine(radiance), normals, views, roughness)
    return rms(found.rgb[rows, columns] - expected) / max(rms(expected), 1e-300)


def _fine(radiance: Array32) -> Array:
    source = clean(radiance)
    return np.asarray(resample(source, 128, 256)) if source.shape[0] > 128 else source


def _ball_pixels(height: int, width: int) -> tuple[NDArray[np.intp], NDArray[np.intp], Array, Array]:
    """Every so many pixels of the ball, not at its rim: rows, columns, normals, directions to the camera."""
    directions = pixel_directions(height, width).reshape(-1, 3)
    along = -directions[:, 2] * BALL_DISTANCE
    under_root = along**2 - (BALL_DISTANCE**2 - BALL_RADIUS**2)
    hit = np.flatnonzero((under_root > 0) & (along > 0))
    points = directions[hit] * (along[hit] - np.sqrt(under_root[hit]))[:, None]
    normals = (points - (0, 0, -BALL_DISTANCE)) / BALL_RADIUS
    inner = np.flatnonzero((normals * -directions[hit]).sum(axis=1) > 0.25)
    chosen = inner[:: max(1, len(inner) // 200)]
    return hit[chosen] // width, hit[chosen] % width, normals[chosen], -directions[hit[chosen]]


def probe_table(maps: Maps) -> Iterator[str]:
    """Madsen's probe: four lights and an ambient term, and as few as do."""
    yield "probe fit: error % of the probe's irradiance, milliseconds without the probe's rendering, which is the last column"
    yield (f"{'map':26}{'error':>7}{'cold':>7}{'steps':>7}{'warm':>7}{'steps':>7} |{'auto N':>7}{'error':>7}{'cold':>7}"
           f"{'warm':>7} |{'probe':>7}")
    for name, radiance in maps:
        given = reduced(radiance)
        moved = np.roll(given, 1, axis=1) * 1.01
        rendering = milliseconds(partial(probe_irradiance, given))
        row = f"{name:26}"
        for count in (4, None):
            cold_ms, warm_ms, fits = _probe_times(given, moved, count)
            row += f"{len(fits[0].directions):7}" if count is None else ""
            row += f"{100 * fits[0].error:7.2f}{cold_ms - rendering:7.2f}" + (f"{fits[0].iterations:7}" if count else "")
            row += f"{warm_ms - rendering:7.2f}" + (f"{fits[1].iterations:7} |" if count else " |")
        yield row + f"{rendering:7.2f}"


def _probe_times(given: Array, moved: Array, count: int | None) -> tuple[float, float, list[ProbeFit]]:
    guess = np.array([item.light.direction for item in find_candidates(_as_map(given)).candidates]).reshape(-1, 3)
    cold, warm = [], []
    for _ in range(20):
        probe, start = Probe(), time.perf_counter()
        first = probe.fit(given, lambda: guess, count)
        middle = time.perf_counter()
        second = probe.fit(moved, lambda: guess, count)
        cold.append(middle - start)
        warm.append(time.perf_counter() - middle)
    return float(np.median(cold)) * 1e3, float(np.median(warm)) * 1e3, [first, second]


def detection_table(maps: Maps) -> Iterator[str]:
    """Finding and following lights in a map, and the papers' way at their size."""
    yield "light detection, milliseconds: ours with tracking on its map, the papers' on 600 x 150"
    yield f"{'map':26}{'ours':>7}{'lights':>7} |{'papers':>7}{'lights':>7}"
    for name, radiance in maps:
        given = reduced(radiance)
        upper = np.asarray(resample(clean(radiance), HEIGHT, WIDTH)[:HEIGHT // 2], dtype=np.float32)
        tracker = LightTracker()
        ours, theirs = milliseconds(partial(_followed, tracker, given)), milliseconds(partial(detect_by_threshold, upper, given))
        yield (f"{name:26}{ours:7.2f}{len(_followed(tracker, given).lights):7} |"
               f"{theirs:7.2f}{len(detect_by_threshold(upper, given).lights):7}")


def _diffuse(method: str, soft: Array32) -> Array32:
    return diffuse_map(method, soft, project(soft))


def _followed(tracker: LightTracker, radiance: Array) -> Detection:
    return tracker.update(find_candidates(_as_map(radiance)))


def _as_map(radiance: Array) -> RadianceMap:
    """In single precision, as it comes from the GPU."""
    return RadianceMap(radiance.astype(np.float32), np.zeros(radiance.shape[:2], dtype=np.float32))


def rms(values: Array) -> float:
    return float(np.sqrt((np.asarray(values) ** 2).mean()))


def milliseconds(work: Callable[[], object], repeats: int = REPEATS) -> float:
    """Median of so many runs."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return float(np.median(times)) * 1e3

"""Light detection on maps whose lamps are known: where, how strong, and what irradiance comes of it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from renderer.equirectangular import solid_angles
from renderer.frame import RadianceFrame
from renderer.light.detection import Detection, Light
from renderer.light.inverse_tone_mapping import WEIGHTS
from renderer.light.irradiance import disc_cosine
from renderer.scene import Lighting
from server.bench.ball_shadow import quadrature
from server.bench.effort import Effort
from server.bench.light_reference import random_normals, summed_irradiance
from server.bench.pipelines import Pipelines
from server.bench.rows import Mark, Row, relative
from server.bench.worlds import World, worlds

Array = NDArray[np.float64]
STAGE = "lights"
MEASURE = ("irradiance over the sphere of normals from the lights found and, by summation, what they leave of the map, less "
           "that of the true sky and discs; in units of its rms. Direction (degrees) and power of the light nearest to each "
           "true one")
STEP = 1 / 30
FAR = 20.0       # degrees: a light further off is another one


def light_rows(pipelines: Pipelines, effort: Effort) -> Iterator[Row]:
    counts: list[int | Literal["auto"]] = [*range(1, 9), "auto"] if effort.name == "full" else [1, 4, "auto"]
    methods: list[tuple[str, str, Mark, Lighting]] = [("default", "", "default", Lighting()),
                                                     ("threshold", "", "paper", Lighting(lights="threshold"))]
    methods += [("probe", f"{count}", "", Lighting(lights="probe", light_count=count)) for count in counts]
    normals = random_normals(effort.normals)
    for world in worlds(effort.still, effort.worlds):
        expected = exact_irradiance(world, normals)
        for method, params, mark, lighting in methods:
            times, detection = _followed(pipelines, world, lighting, effort.per_world)
            found = detected_irradiance(detection, normals)
            yield Row(STAGE, method, world.name, relative(found, expected), times, params, mark, _matches(world, detection))
        mean = (world.radiance * solid_angles(*world.radiance.shape[:2])[..., None]).sum(axis=(0, 1)) / 4
        yield Row(STAGE, "constant ambient", world.name, relative(np.broadcast_to(mean, expected.shape), expected), mark="null")


def exact_irradiance(world: World, normals: Array) -> Array:
    """(n, 3) from the sky by summation and from the discs by `ring_cosine`."""
    discs = (ring_cosine(normals @ light.direction, light.angular_radius)[:, None] * light.irradiance for light in world.lights)
    return summed_irradiance(world.sky, normals) + sum(discs, np.zeros((len(normals), 3)))


def ring_cosine(cosine: Array, angular_radius: float) -> Array:
    """(n,) irradiance of a disc by that on a plane that faces it: around each ring of the disc max(0, cos) has an integral in
    closed form; over the rings by quadrature (Gauss-Legendre, 64 nodes in the square of the sine)."""
    nodes, weights = quadrature(64)
    sine2 = (nodes + 1) / 2 * np.sin(angular_radius) ** 2
    middle = np.asarray(cosine)[:, None] * np.sqrt(1 - sine2)
    swing = np.sqrt(np.maximum(1 - np.asarray(cosine)[:, None] ** 2, 0.0)) * np.sqrt(sine2)
    # middle + swing cos(phi) > 0 for |phi| < edge
    edge = np.arccos(np.clip(-middle / np.maximum(swing, 1e-300), -1, 1))
    ring = (middle * edge + swing * np.sin(edge)) / np.pi
    # d(solid angle) cos = sin cos dr dphi is d(sine2) / 2 dphi; the radiance of irradiance 1 is 1 / (pi sin2 a)
    return np.asarray((ring / np.sqrt(1 - sine2)) @ weights / 2)


def detected_irradiance(detection: Detection, normals: Array) -> Array:
    """(n, 3) from what a detection leaves of the map and its lights, as surfaces are lit."""
    found = summed_irradiance(detection.soft, normals)
    for light in detection.lights:
        if not light.is_wide:
            found += disc_cosine(normals @ light.direction, light.angular_radius)[:, None] * light.irradiance
    return found


def _followed(pipelines: Pipelines, world: World, lighting: Lighting, repeats: int) -> tuple[Array, Detection]:
    """What finding the lights costs in frames that turn by a texel to and fro, and the lights of the map itself."""
    frames = [RadianceFrame(np.roll(world.radiance, shift, axis=1)) for shift in (0, 4)]
    pipeline, times = pipelines.of(frames[0]), []
    for index in range(repeats + 4):
        timings = pipeline.analyse(frames[index % 2], index * STEP, lighting)[1].stages
        times.append(timings.get("highlights", 0.0) + timings["lights"])
    first = pipelines.light(frames[0], lighting).detection
    return np.array(times[4:]), first


def _matches(world: World, detection: Detection) -> dict[str, float | None]:
    """Of the true lights: the nearest one's direction and power, and how many were not found."""
    if not world.lights:
        return {"direction_deg": None, "power": None, "missed": 0.0, "false": float(len(detection.lights))}
    if not detection.lights:
        return {"direction_deg": None, "power": None, "missed": float(len(world.lights)), "false": 0.0}
    angles = np.degrees(np.arccos(np.clip(_directions(world.lights) @ _directions(detection.lights).T, -1, 1)))
    matched = zip(*linear_sum_assignment(angles), strict=True)
    pairs = [(int(true), int(found)) for true, found in matched if angles[true, found] < FAR]
    power = [abs(_power(detection.lights[found]) / _power(world.lights[true]) - 1) for true, found in pairs]
    return {"direction_deg": float(np.mean([angles[pair] for pair in pairs])) if pairs else None,
            "power": float(np.mean(power)) if power else None, "missed": float(len(world.lights) - len(pairs)),
            "false": float(len(detection.lights) - len(pairs))}


def _directions(lights: tuple[Light, ...]) -> Array:
    return np.array([light.direction for light in lights])


def _power(light: Light) -> float:
    return float(light.irradiance @ WEIGHTS)

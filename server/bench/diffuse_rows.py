"""Diffuse light: each method on the same map, of which the lights have been taken out truly, against summation over its texels."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np
from numpy.typing import NDArray

from renderer.equirectangular import solid_angles
from renderer.light.diffuse import diffuse_map
from renderer.light.irradiance import project
from renderer.light.specular import resample
from server.bench.effort import Effort
from server.bench.light_reference import interpolated, random_normals, summed_irradiance
from server.bench.pipelines import Pipelines
from server.bench.rows import Mark, Row, relative, timed
from server.bench.worlds import worlds

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
STAGE = "diffuse"
MEASURE = ("irradiance over the sphere of normals, as a shader interpolates it in the method's map, less summation over every "
           "texel; in units of its rms. The map is without its lights, as this stage gets it; `lights in map`: with them, as "
           "in Iorns & Rhee")
METHODS: dict[str, Mark] = {"auto": "default", "sh": "", "convolution": "", "map16x8": "", "map32x16": "paper", "map64x32": "",
                            "map128x64": ""}
ROWS = 64       # of the map that the methods are given


def diffuse_rows(_pipelines: Pipelines, effort: Effort) -> Iterator[Row]:
    normals = random_normals(effort.normals)
    for world in worlds(effort.still, effort.worlds):
        maps: dict[str, NDArray[np.floating]] = {"no lights in map": world.sky}
        if world.lights:
            maps["lights in map"] = world.radiance
        for condition, radiance in maps.items():
            soft = np.asarray(resample(radiance, ROWS, 2 * ROWS), dtype=np.float32)
            expected = summed_irradiance(radiance, normals)
            for method, mark in METHODS.items():
                work = partial(_irradiance, method, soft)
                times = timed(work, effort.repeats)
                found = interpolated(work().astype(np.float64), normals)
                yield Row(STAGE, method, world.name, relative(found, expected), times, condition=condition,
                          mark=mark if radiance is world.sky else "")
            mean = (radiance * solid_angles(*radiance.shape[:2])[..., None]).sum(axis=(0, 1)) / 4
            errors = relative(np.broadcast_to(mean, expected.shape), expected)
            yield Row(STAGE, "constant ambient", world.name, errors, condition=condition, mark="null")


def _irradiance(method: str, soft: Array32) -> Array32:
    """With the harmonics for those methods that need them."""
    needs_harmonics = method in ("auto", "sh")
    return diffuse_map(method, soft, project(soft) if needs_harmonics else np.zeros((25, 3)))

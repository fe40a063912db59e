"""Glossy light: maps prefiltered at some size, and the papers' 36 rings, against the integral of the lobe around a direction."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import moderngl
import numpy as np
from numpy.typing import NDArray

from renderer.equirectangular import pixel_directions
from renderer.frame import RadianceFrame
from renderer.gl import Context, load_shader, release_all, set_uniforms
from renderer.light.ring_sampling import RingSource
from renderer.light.specular import azimuthal_kernel, filtered, ggx_lobe, map_rows, resample, spectrum_of
from renderer.panorama import PanoramaTextures
from server.bench.effort import Effort
from server.bench.light_reference import random_normals, weighted_mean
from server.bench.pipelines import Pipelines
from server.bench.rows import Mark, Row, relative, timed
from server.bench.worlds import World, worlds

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
STAGE = "glossy"
MEASURE = ("radiance in a GGX lobe (N = V = R) around random directions, less the lobe's integral over every texel of the sky "
           "without its lights; in units of its rms. Time: what a frame costs for one roughness, 256 x 256 shaded pixels "
           "included. `own lobe`: the papers' rings against the Phong lobe that they sample")
PIXELS = 256        # a side, shaded
SIZES = (16, 32, 64)
FULL_SCREEN = "full_screen.vert.glsl"
UNIT = 9
HEAD = """#version 430 core
uniform sampler2D towards;
uniform float roughness;
out vec4 found;"""
RINGS = "void main() { found = vec4(ring_light(texelFetch(towards, ivec2(gl_FragCoord.xy), 0).xyz, roughness), 1.0); }"
LOOK_UP = """uniform sampler2D lobe_map;
void main() { found = textureLod(lobe_map, uv_from_direction(texelFetch(towards, ivec2(gl_FragCoord.xy), 0).xyz), 0.0); }"""


def glossy_rows(pipelines: Pipelines, effort: Effort) -> Iterator[Row]:
    directions = random_normals(effort.directions)
    look_up, rings = LookUp(pipelines.context), Rings(pipelines.context, effort.still)
    for world in worlds(effort.still, effort.worlds):
        fine = np.asarray(resample(world.sky, 128, 256), dtype=np.float64).repeat(2, axis=0).repeat(2, axis=1)
        soft = np.asarray(resample(world.sky, 64, 128), dtype=np.float32)
        for roughness in effort.roughnesses:
            lobe = weighted_mean(fine, _ggx(directions, roughness))
            for rows in SIZES:
                mark: Mark = "default" if rows == map_rows(roughness) else ""
                times, found = look_up.measured(soft, roughness, rows, directions, effort.per_world)
                yield Row(STAGE, f"prefiltered {rows} rows", world.name, relative(found, lobe), times, mark=mark,
                          condition=f"r={roughness}")
            times, found = rings.measured(world, roughness, directions, effort.per_world)
            yield Row(STAGE, "rings36", world.name, relative(found, lobe), times, condition=f"r={roughness}", mark="paper")
            own = weighted_mean(fine, _phong(directions, roughness))
            yield Row(STAGE, "rings36 own lobe", world.name, relative(found, own), condition=f"r={roughness}")
            yield Row(STAGE, "constant", world.name, relative(np.broadcast_to(fine.mean(axis=(0, 1)), lobe.shape), lobe),
                      condition=f"r={roughness}", mark="null")
    look_up.release()
    rings.release()


def _ggx(directions: Array, roughness: float) -> Callable[[Array], NDArray[np.floating]]:
    return lambda towards: ggx_lobe(np.clip(directions @ towards.T, -1, 1), roughness)


def _phong(directions: Array, roughness: float) -> Callable[[Array], NDArray[np.floating]]:
    """As rings.glsl has it."""
    exponent = max(0.5 / roughness**4 - 0.5, 1.0)
    return lambda towards: np.maximum(directions @ towards.T, 0.0) ** exponent


class Probe:
    """Runs a shader for every pixel of a square; the first pixels look in the directions that are asked for."""

    def __init__(self, context: Context, body: str, includes: tuple[str, ...]) -> None:
        self._context = context
        sources = [load_shader(name).text.split("\n", 1)[1] for name in includes]
        fragment = "\n".join((HEAD, *sources, body))
        self._program = context.gl.program(vertex_shader=load_shader(FULL_SCREEN).text, fragment_shader=fragment)
        self._triangle = context.gl.vertex_array(self._program, [])
        self._towards = context.texture((PIXELS, PIXELS), 4, "f4", linear=False)
        self._target = context.gl.simple_framebuffer((PIXELS, PIXELS), 4, dtype="f4")

    def look(self, directions: Array) -> None:
        pixels = np.zeros((PIXELS * PIXELS, 4), dtype=np.float32)
        pixels[:, :3] = pixel_directions(PIXELS, PIXELS).reshape(-1, 3)     # neighbours look at neighbours, as on a surface
        pixels[:len(directions), :3] = directions
        self._towards.write(pixels.tobytes())

    def run(self, name: str, texture: moderngl.Texture, roughness: float) -> None:
        texture.use(UNIT)
        self._towards.use(UNIT + 1)
        set_uniforms(self._program, {name: UNIT, "towards": UNIT + 1, "roughness": roughness})
        self._target.use()
        self._triangle.render(moderngl.TRIANGLES, 3)
        self._context.gl.finish()

    def read(self, count: int) -> Array:
        data = np.frombuffer(self._target.read(components=4, dtype="f4"), "f4").reshape(-1, 4)
        return np.asarray(data[:count, :3], dtype=np.float64)

    def release(self) -> None:
        self._context.rest()
        release_all(self._target, self._towards, self._triangle, self._program)


class LookUp:
    """Prefilter, upload and one bilinear look-up a pixel."""

    def __init__(self, context: Context) -> None:
        self._context = context
        self._probe = Probe(context, LOOK_UP, ("equirectangular.glsl",))

    def measured(self, soft: Array32, roughness: float, rows: int, directions: Array, repeats: int) -> tuple[Array, Array]:
        texture = self._context.texture((2 * rows, rows), 3, "f4", wrap_x=True)
        kernel = spectrum_of(azimuthal_kernel(lambda cosine: ggx_lobe(cosine, roughness), rows, rows, rows))
        self._probe.look(directions)

        def work() -> None:
            small = soft if rows == soft.shape[0] else np.asarray(resample(soft, rows, 2 * rows), dtype=np.float32)
            texture.write(np.ascontiguousarray(filtered(small, kernel)))
            self._probe.run("lobe_map", texture, roughness)

        times, found = timed(work, repeats), self._probe.read(len(directions))
        texture.release()
        return times, found

    def release(self) -> None:
        self._probe.release()


class Rings:
    """The frame with its mip levels made anew, and 36 look-ups a pixel."""

    def __init__(self, context: Context, size: tuple[int, int]) -> None:
        self._probe = Probe(context, RINGS, ("equirectangular.glsl", "rings.glsl"))
        self._panorama = PanoramaTextures(context, RadianceFrame, size)
        self._source = RingSource(context, self._panorama, (256, 128))
        self._kept = np.ones((128, 256), np.float32)

    def measured(self, world: World, roughness: float, directions: Array, repeats: int) -> tuple[Array, Array]:
        self._panorama.show(RadianceFrame(world.sky.astype(np.float32)))
        self._probe.look(directions)

        def work() -> None:
            self._source.fill(self._kept, 0.0)
            self._probe.run("ring_map", self._source.texture, roughness)

        return timed(work, repeats), self._probe.read(len(directions))

    def release(self) -> None:
        self._probe.release()
        self._source.release()
        self._panorama.release()

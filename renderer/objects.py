"""Draws the scene's objects into perspective views: surfaces multisampled, then shaded once a pixel by the frame's light.

Shading while rasterising costs a software renderer one run of the shader for 4 x 4 pixels of every triangle: 91 ms for a
teapot of 9,120 triangles in a view of 242 x 136 pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import moderngl
import numpy as np
from numpy.typing import NDArray

from renderer.gl import GL_CLIP_DISTANCE0, Context, release_all, set_uniforms
from renderer.irradiance import COSINE_LOBE
from renderer.light_detection import Light
from renderer.mesh import Mesh, Primitive, Surface
from renderer.panorama import PanoramaTextures, source_defines
from renderer.placement import View
from renderer.specular import MIN_ROUGHNESS, Array32, dfg_table

Array = NDArray[np.float64]
SAMPLES = 4
SIZE_STEP = 64            # view targets come in a few sizes, so that moving objects do not allocate
FIRST_UNIT = 8            # texture units after the panorama's
BELOW_NOTHING = -1e9
NO_TEXTURES: list[moderngl.Texture | None] = [None, None, None]
MAX_LOBES = 16         # roughness values in one frame; as in shade.frag.glsl
MIRROR_BELOW = MIN_ROUGHNESS / 2


@dataclass(frozen=True)
class Illumination:
    """What lights the objects in one frame: (25, 3) radiance coefficients of the residual, the lights taken out of it, the
    residual prefiltered for each roughness in use, the ground's height (None: no ground)."""

    coefficients: Array
    lights: tuple[Light, ...]
    lobes: dict[float, Array32]
    ground_y: float | None


@dataclass(frozen=True)
class PlacedMesh:
    """A mesh in the world. `surface` replaces the mesh's own surfaces when it is not None."""

    mesh: GpuMesh
    world_from_model: Array
    surface: Surface | None


class GpuMesh:
    """Vertex buffers and textures of one mesh."""

    def __init__(self, context: Context, programs: dict[bool, moderngl.Program], mesh: Mesh) -> None:
        self.mesh = mesh
        self.parts = [_Part(context, programs, primitive) for primitive in mesh.primitives]

    def release(self) -> None:
        for part in self.parts:
            part.release()


class _Part:
    def __init__(self, context: Context, programs: dict[bool, moderngl.Program], primitive: Primitive) -> None:
        gl = context.gl
        self.surface = primitive.surface
        s = primitive.surface
        self.textures = [_material_texture(context, image) for image in
                         (s.base_color_texture, s.metallic_roughness_texture, s.emissive_texture)]
        vertices = np.concatenate([primitive.positions, primitive.normals, primitive.uvs], axis=1).astype("f4")
        self._buffers = [gl.buffer(vertices.tobytes()), gl.buffer(primitive.triangles.astype("i4").tobytes())]
        self.vertex_arrays = {
            textured: gl.vertex_array(program, [(self._buffers[0], "3f 3f 2f" if textured else "3f 3f 8x",
                                                 *(("position", "normal", "uv") if textured else ("position", "normal")))],
                                      index_buffer=self._buffers[1], index_element_size=4)
            for textured, program in programs.items()}

    def release(self) -> None:
        release_all(*self.vertex_arrays.values(), *self._buffers, *self.textures)


def _material_texture(context: Context, image: NDArray[np.uint8] | None) -> moderngl.Texture | None:
    if image is None:
        return None
    texture = context.gl.texture((image.shape[1], image.shape[0]), 4, np.ascontiguousarray(image).tobytes())
    texture.build_mipmaps()
    texture.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)
    return texture


class _ViewTarget:
    """Multisampled surface buffers of one size, their resolved copies and the shaded result."""

    DTYPES = ((4, "f2"), (4, "f1"), (4, "f2"), (1, "f4"))   # normal + coverage, colour + metallic, emissive + roughness, distance

    def __init__(self, context: Context, size: tuple[int, int]) -> None:
        gl = context.gl
        self._samples = [gl.renderbuffer(size, components, samples=SAMPLES, dtype=dtype) for components, dtype in self.DTYPES]
        self._depth = gl.depth_renderbuffer(size, samples=SAMPLES)
        self.framebuffer = gl.framebuffer(self._samples, self._depth)
        self.surface = [context.texture(size, components, dtype, linear=False) for components, dtype in self.DTYPES]
        self.resolved = gl.framebuffer(self.surface)
        self.texture = context.texture(size, 4, "f2")
        self.shaded = gl.framebuffer([self.texture])

    def release(self) -> None:
        release_all(self.framebuffer, self.resolved, self.shaded, self.texture, *self.surface, *self._samples, self._depth)


class ObjectStage:
    """Owns the surface and shading programs, their look-up textures and the view targets."""

    def __init__(self, context: Context, panorama: PanoramaTextures, radiance_texture: moderngl.Texture) -> None:
        self._context = context
        self._panorama = panorama
        self._radiance_texture = radiance_texture
        self.surface_programs = {textured: context.program("surface.vert.glsl", "surface.frag.glsl", {"TEXTURED": int(textured)})
                                 for textured in (False, True)}
        self._program = context.program("full_screen.vert.glsl", "shade.frag.glsl", source_defines(panorama.kind))
        self._triangle = context.gl.vertex_array(self._program, [])
        table = dfg_table()
        self._dfg = context.texture((table.shape[1], table.shape[0]), 2, "f4")
        self._dfg.write(table.tobytes())
        self._targets: dict[tuple[int, int], _ViewTarget] = {}
        self._lobe_atlas = context.texture((1, 1), 4, "f4")

    def set_illumination(self, illumination: Illumination) -> None:
        """Upload one frame's light."""
        self._set_lobes(illumination.lobes)
        lights = illumination.lights
        pad = ((0, 8 - len(lights)), (0, 0))
        set_uniforms(self._program, {
            "irradiance_sh": illumination.coefficients * COSINE_LOBE[:, None],
            "light_count": len(lights),
            "light_direction": np.pad(np.array([light.direction for light in lights]).reshape(-1, 3), pad),
            "light_irradiance": np.pad(np.array([light.irradiance for light in lights]).reshape(-1, 3), pad),
            "light_radius": np.array([light.angular_radius for light in lights] + [0.0] * (8 - len(lights))),
            "mirror_below": MIRROR_BELOW,
            "ground_y": illumination.ground_y or 0.0,
            "has_ground": int(illumination.ground_y is not None),
        })
        for program in self.surface_programs.values():
            below = BELOW_NOTHING if illumination.ground_y is None else illumination.ground_y - 1e-4
            set_uniforms(program, {"clip_below_y": below})

    def _set_lobes(self, lobes: dict[float, Array32]) -> None:
        """Stack the prefiltered maps in one texture, each with a border of its own wrapped columns and repeated pole rows."""
        if not lobes:
            set_uniforms(self._program, {"lobe_count": 0})
            return
        ordered = sorted(lobes.items())[:MAX_LOBES]
        width = max(lobe.shape[1] for _, lobe in ordered) + 2
        height = sum(lobe.shape[0] + 2 for _, lobe in ordered)
        atlas = np.zeros((height, width, 4), dtype="f4")
        table = np.zeros((MAX_LOBES, 4))
        top = 0
        for index, (roughness, lobe) in enumerate(ordered):
            rows, columns = lobe.shape[:2]
            padded = np.pad(np.pad(lobe, ((0, 0), (1, 1), (0, 0)), mode="wrap"), ((1, 1), (0, 0), (0, 0)), mode="edge")
            atlas[top:top + rows + 2, :columns + 2, :3] = padded
            table[index] = (roughness, columns / width, (top + 1) / height, rows / height)
            top += rows + 2
        if self._lobe_atlas.size != (width, height):
            self._lobe_atlas.release()
            self._lobe_atlas = self._context.texture((width, height), 4, "f4")
        self._lobe_atlas.write(atlas)
        set_uniforms(self._program, {"lobe_count": len(ordered), "lobe": table, "lobe_border": (1 / width, 0.0)})

    def draw(self, view: View, objects: list[PlacedMesh]) -> tuple[moderngl.Texture, tuple[int, int]]:
        """Draw the view's members. Returns the texture and the part of it, in pixels, that the view fills."""
        size = (-(-view.size[0] // SIZE_STEP) * SIZE_STEP, -(-view.size[1] // SIZE_STEP) * SIZE_STEP)
        target = self._targets.get(size)
        if target is None:
            target = self._targets[size] = _ViewTarget(self._context, size)
        self._draw_surfaces(view, objects, target)
        self._context.gl.copy_framebuffer(target.resolved, target.framebuffer)
        self._shade(view, target)
        return target.texture, view.size

    def _draw_surfaces(self, view: View, objects: list[PlacedMesh], target: _ViewTarget) -> None:
        gl = self._context.gl
        target.framebuffer.use()
        target.framebuffer.viewport = (0, 0, *target.texture.size)
        target.framebuffer.clear(0.0, 0.0, 0.0, 0.0)
        target.framebuffer.viewport = (0, 0, *view.size)
        gl.enable_only(moderngl.DEPTH_TEST)
        gl.enable_direct(GL_CLIP_DISTANCE0)
        for program in self.surface_programs.values():
            set_uniforms(program, {"clip_from_world": view.clip_from_world().T})
        for index in view.members:
            self._draw_object(objects[index])
        gl.disable_direct(GL_CLIP_DISTANCE0)
        gl.enable_only(moderngl.NOTHING)

    def _draw_object(self, placed: PlacedMesh) -> None:
        linear = placed.world_from_model[:3, :3]
        gl = self._context.gl
        gl.front_face = "cw" if np.linalg.det(linear) < 0 else "ccw"
        transforms = {"world_from_model": placed.world_from_model.T,
                      "normal_from_model": np.linalg.inv(linear)}  # its transpose, in GL's column order
        for part in placed.mesh.parts:
            surface = placed.surface or part.surface
            textures = NO_TEXTURES if placed.surface else part.textures
            textured = any(textures) or surface.alpha_cutoff is not None
            program = self.surface_programs[textured]
            if surface.double_sided:
                gl.disable(moderngl.CULL_FACE)
            else:
                gl.enable(moderngl.CULL_FACE)
            set_uniforms(program, {**transforms, "base_color": surface.base_color, "metallic": surface.metallic,
                                   "roughness": surface.roughness, "emissive": surface.emissive})
            if textured:
                self._bind_textures(program, surface, textures)
            part.vertex_arrays[textured].render()
        gl.front_face = "ccw"

    @staticmethod
    def _bind_textures(program: moderngl.Program, surface: Surface, textures: list[moderngl.Texture | None]) -> None:
        names = ("base_color_texture", "metallic_roughness_texture", "emissive_texture")
        bits = 0
        for bit, (name, texture) in enumerate(zip(names, textures, strict=True)):
            set_uniforms(program, {name: FIRST_UNIT + bit})
            if texture is not None:
                texture.use(FIRST_UNIT + bit)
                bits |= 1 << bit
        set_uniforms(program, {"has_textures": bits,
                               "alpha_cutoff": -1.0 if surface.alpha_cutoff is None else surface.alpha_cutoff})

    def _shade(self, view: View, target: _ViewTarget) -> None:
        target.shaded.use()
        target.shaded.viewport = (0, 0, *view.size)
        self._panorama.bind(self._program)
        textures = {"normal_coverage": target.surface[0], "color_metallic": target.surface[1],
                    "emissive_roughness": target.surface[2], "distance_from_camera": target.surface[3],
                    "radiance_map": self._radiance_texture, "dfg_table": self._dfg, "lobe_atlas": self._lobe_atlas}
        for unit, (name, texture) in enumerate(textures.items(), start=FIRST_UNIT):
            texture.use(unit)
            set_uniforms(self._program, {name: unit})
        left, right, bottom, top = view.bounds
        set_uniforms(self._program, {"world_from_view": view.rotation,  # GL reads rows as columns: the transpose
                                     "view_bounds": (left, bottom, right - left, top - bottom), "view_size": view.size})
        self._triangle.render(moderngl.TRIANGLES, 3)

    def release(self) -> None:
        release_all(*self._targets.values(), self._lobe_atlas, self._dfg, self._triangle, self._program,
                     *self.surface_programs.values())

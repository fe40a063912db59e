"""Draws the scene's objects into perspective views: surfaces with 2 x 2 samples a pixel, then shaded once a pixel.

Shading while rasterising costs a software renderer one run of the shader for 4 x 4 pixels of every triangle, and its
multisampling more than drawing at twice the size.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import NamedTuple

import moderngl
import numpy as np
from numpy.typing import NDArray

from renderer.gl import GL_CLIP_DISTANCE0, Context, release_all, set_uniforms
from renderer.light_detection import Light
from renderer.mesh import Mesh, Primitive, Surface
from renderer.panorama import PanoramaTextures
from renderer.placement import View
from renderer.specular import MIN_ROUGHNESS, Array32, dfg_table, quantized_roughness

Array = NDArray[np.float64]
SAMPLES = 2               # a side of a pixel
SIZE_STEP = 64            # view targets come in a few sizes, so that moving objects do not allocate
NO_POWER_OF_TWO = 8       # added to them: llvmpipe compiles other programs for powers of two, in mid-stream when one first comes
FIRST_UNIT = 8            # texture units after the panorama's
BELOW_NOTHING = -1e9
LIGHT_SLOTS = (2, 4, 8)   # lights: each number has a program of its own, with a constant loop
MAX_SURFACES = 512
NO_TEXTURES: list[moderngl.Texture | None] = [None, None, None]
MAX_LOBES = 16         # roughness values in one frame; as in shade.frag.glsl
MIRROR_BELOW = MIN_ROUGHNESS / 2


@dataclass(frozen=True)
class Illumination:
    """What lights the objects in one frame: irradiance by normal and radiance prefiltered for each roughness in use, both of
    the map without its lights; the lights; the ground's height (None: no ground); the frame with mip levels where the papers'
    rings stand in for the prefiltered maps."""

    irradiance: Array32
    lights: tuple[Light, ...]
    lobes: dict[float, Array32]
    ground_y: float | None
    rings: moderngl.Texture | None = None


@dataclass(frozen=True)
class PlacedMesh:
    """A mesh in the world. `surface` replaces the mesh's own surfaces when it is not None."""

    mesh: GpuMesh
    world_from_model: Array
    surface: Surface | None

    @property
    def surfaces(self) -> list[Surface]:
        return [self.surface] if self.surface else [part.surface for part in self.mesh.parts]

    @property
    def may_mirror(self) -> bool:
        """Whether a part is smooth enough to show the frame itself; a textured one may be."""
        return self.mesh.is_textured(self.surface) or any(surface.roughness < MIRROR_BELOW for surface in self.surfaces)


class GpuMesh:
    """Vertex buffers and textures of one mesh."""

    def __init__(self, context: Context, programs: dict[bool, moderngl.Program], mesh: Mesh) -> None:
        self.mesh = mesh
        self.parts = [_Part(context, programs, primitive) for primitive in mesh.primitives]

    def release(self) -> None:
        for part in self.parts:
            part.release()


    def is_textured(self, override: Surface | None) -> bool:
        return override is None and any(part.is_textured for part in self.parts)


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

    @property
    def is_textured(self) -> bool:
        return any(texture is not None for texture in self.textures) or self.surface.alpha_cutoff is not None

    def release(self) -> None:
        release_all(*self.vertex_arrays.values(), *self._buffers, *self.textures)


def _material_texture(context: Context, image: NDArray[np.uint8] | None) -> moderngl.Texture | None:
    if image is None:
        return None
    texture = context.gl.texture((image.shape[1], image.shape[0]), 4, np.ascontiguousarray(image).tobytes())
    texture.build_mipmaps()
    texture.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)
    return texture


class Shading(NamedTuple):
    """What a view's pixels need; each combination in use is a program of its own."""

    textured: bool
    lights: int
    lobes: bool
    mirrors: bool
    rings: bool = False

    @property
    def shows_frame(self) -> bool:
        """Whether every frame needs shading of its own, even if neither light nor surfaces have changed."""
        return self.mirrors or self.rings


class _ViewTarget:
    """Sample buffers of one size and the shaded result. Textured views have the surface in two more buffers."""

    def __init__(self, context: Context, size: tuple[int, int], textured: bool) -> None:
        gl = context.gl
        sampled = (size[0] * SAMPLES, size[1] * SAMPLES)
        dtypes = ["f4", "f1", "f2"] if textured else ["f4"]
        self.samples = [context.texture(sampled, 4, dtype, linear=False) for dtype in dtypes]
        self._depth = gl.depth_renderbuffer(sampled)
        self.framebuffer = gl.framebuffer(self.samples, self._depth)
        self.texture = context.texture(size, 4, "f2")
        self.shaded = gl.framebuffer([self.texture])
        self.surfaces = context.texture((3, MAX_SURFACES), 4, "f4", linear=False)
        self.view: View | None = None           # whose surfaces are in the samples
        self.roughnesses: list[float] = []      # of those surfaces
        self.lobe_cells: dict[float, tuple[float, float, float]] = {}
        self.lit_by: Illumination | None = None

    def release(self) -> None:
        release_all(self.framebuffer, self.shaded, self.texture, self.surfaces, *self.samples, self._depth)


class ObjectStage:
    """Owns the surface and shading programs, their look-up textures and the view targets."""

    def __init__(self, context: Context, panorama: PanoramaTextures, radiance_texture: moderngl.Texture) -> None:
        self._context = context
        self._panorama = panorama
        self._radiance_texture = radiance_texture
        self.surface_programs = {textured: context.program("surface.vert.glsl", "surface.frag.glsl", {"TEXTURED": int(textured)})
                                 for textured in (False, True)}
        self._shading: dict[Shading, tuple[moderngl.Program, moderngl.VertexArray]] = {}
        table = dfg_table()
        self._dfg = context.texture((table.shape[1], table.shape[0]), 4, "f4")
        self._dfg.write(table.tobytes())
        self._targets: dict[tuple[int, int, bool], list[_ViewTarget]] = {}
        self._lobe_atlas = context.texture((1, 1), 4, "f4")
        self._uniforms: dict[str, object] = {}
        self._illumination: Illumination | None = None
        self._slots = LIGHT_SLOTS[0]
        self._lobe_cells: dict[float, tuple[float, float, float]] = {}

    def _shading_program(self, kind: Shading) -> tuple[moderngl.Program, moderngl.VertexArray]:
        if kind not in self._shading:
            program = self._context.program("full_screen.vert.glsl", "shade.frag.glsl", {
                **self._panorama.defines, "TEXTURED": int(kind.textured), "LIGHTS": kind.lights,
                "HAS_LOBES": int(kind.lobes), "HAS_MIRRORS": int(kind.mirrors), "HAS_RINGS": int(kind.rings)})
            self._shading[kind] = (program, self._context.gl.vertex_array(program, []))
        return self._shading[kind]

    def set_illumination(self, illumination: Illumination) -> None:
        """Take over one frame's light."""
        self._illumination = illumination
        lights = illumination.lights[:LIGHT_SLOTS[-1]]
        self._slots = next(slots for slots in LIGHT_SLOTS if slots >= len(lights))
        directions, irradiances, radii = np.zeros((self._slots, 3)), np.zeros((self._slots, 3)), np.zeros(self._slots)
        for index, light in enumerate(lights):
            directions[index], irradiances[index], radii[index] = light.direction, light.irradiance, light.angular_radius
        self._uniforms = {
            **self._set_lobes(illumination.irradiance, illumination.lobes),
            "light_direction": directions, "light_irradiance": irradiances, "light_radius": radii,
            "mirror_below": MIRROR_BELOW,
            "ground_y": illumination.ground_y or 0.0,
            "has_ground": int(illumination.ground_y is not None),
        }
        below = BELOW_NOTHING if illumination.ground_y is None else illumination.ground_y - 1e-4
        for program in self.surface_programs.values():
            set_uniforms(program, {"clip_below_y": below})

    def _set_lobes(self, irradiance: Array32, lobes: dict[float, Array32]) -> dict[str, object]:
        """Stack the filtered maps in one texture, each with a border of what lies across its seam and its poles."""
        maps = [irradiance, *(lobe for _, lobe in sorted(lobes.items())[:MAX_LOBES])]
        width = max(one.shape[1] for one in maps) + 2
        height = sum(one.shape[0] + 2 for one in maps)
        atlas = np.zeros((height, width, 4), dtype="f4")
        cells, top = [], 0
        for one in maps:
            rows, columns = one.shape[:2]
            cell = atlas[top:top + rows + 2, :columns + 2, :3]
            cell[1:-1, 1:-1] = one
            cell[0, 1:-1], cell[-1, 1:-1] = np.roll(one[0], columns // 2, axis=0), np.roll(one[-1], columns // 2, axis=0)
            cell[:, 0], cell[:, -1] = cell[:, -2], cell[:, 1]
            cells.append((columns / width, (top + 1) / height, rows / height))
            top += rows + 2
        self._lobe_cells = dict(zip(sorted(lobes), cells[1:], strict=False))
        table = np.zeros((MAX_LOBES, 4))
        for index, (roughness, cell_uv) in enumerate(self._lobe_cells.items()):
            table[index] = (roughness, *cell_uv)
        if self._lobe_atlas.size != (width, height):
            self._lobe_atlas.release()
            self._lobe_atlas = self._context.texture((width, height), 4, "f4")
        self._lobe_atlas.write(atlas)
        return {"lobe_count": len(self._lobe_cells), "lobe": table, "lobe_border": 1 / width, "irradiance_cell": cells[0]}

    def draw(self, view: View, objects: list[PlacedMesh]) -> tuple[moderngl.Texture, tuple[int, int]]:
        """Draw the view's members. Returns the texture and the part of it, in pixels, that the view fills."""
        target, kind = self._prepared(view, objects)
        # what no mirror shows is the same for as long as light and surfaces are
        if kind.shows_frame or target.lit_by is not self._illumination:
            self._shade(view, target, kind)
            target.lit_by = self._illumination
        return target.texture, view.size

    def draw_still(self, views: list[View], objects: list[PlacedMesh]) -> None:
        """Draw, ahead of the next frame, the views that do not depend on it: those without mirrors."""
        for view in views:
            if not self._prepared(view, objects)[1].shows_frame:
                self.draw(view, objects)

    def _prepared(self, view: View, objects: list[PlacedMesh]) -> tuple[_ViewTarget, Shading]:
        """The view's target with its surfaces drawn, and how they are to be shaded."""
        members = [objects[index] for index in view.members]
        textured = any(item.mesh.is_textured(item.surface) for item in members)
        target = self._target(view, textured)
        if target.view is not view or target.lobe_cells != self._lobe_cells:
            target.roughnesses = self._draw_surfaces(view, members, target, textured)
            target.view, target.lobe_cells, target.lit_by = view, self._lobe_cells, None
        glossy = textured or max(target.roughnesses) >= MIRROR_BELOW
        return target, Shading(textured, self._slots, lobes=glossy and bool(self._lobe_cells),
                               mirrors=textured or min(target.roughnesses) < MIRROR_BELOW,
                               rings=glossy and self._illumination is not None and self._illumination.rings is not None)

    def compile_variants(self, view: View) -> None:
        """Shade a view that has been drawn, once with each program that untextured objects may need."""
        illumination, target = self._illumination, next(t for t in itertools.chain(*self._targets.values()) if t.view is view)
        if illumination is None:
            return
        for slots in LIGHT_SLOTS:
            self.set_illumination(replace(illumination, lights=(Light(np.array([0.0, 1.0, 0.0]), np.ones(3), 0.01),) * slots))
            for lobes, mirrors in ((True, False), (False, True), (True, True)):
                self._shade(view, target, Shading(False, slots, lobes, mirrors))
        self.set_illumination(illumination)
        target.lit_by = None

    def keep(self, views: list[View]) -> None:
        """Surfaces of these views stay as drawn until the views are others; the targets of all other views are free."""
        kept = {id(view) for view in views}
        for target in itertools.chain(*self._targets.values()):
            if id(target.view) not in kept:
                target.view = None

    def _target(self, view: View, textured: bool) -> _ViewTarget:
        width, height = (-(-side // SIZE_STEP) * SIZE_STEP + NO_POWER_OF_TWO for side in view.size)
        key = (width, height, textured)
        targets = self._targets.setdefault(key, [])
        for target in targets:
            if target.view is view:
                return target
        free = next((target for target in targets if target.view is None), None)
        if free is None:
            free = _ViewTarget(self._context, key[:2], textured)
            targets.append(free)
        return free

    def _draw_surfaces(self, view: View, members: list[PlacedMesh], target: _ViewTarget, textured: bool) -> list[float]:
        """Returns the roughness of every surface."""
        gl = self._context.gl
        target.framebuffer.use()
        width, height = view.size[0] * SAMPLES, view.size[1] * SAMPLES
        target.framebuffer.viewport = (0, 0, width, height)
        target.framebuffer.clear(0.0, 0.0, 0.0, 0.0, viewport=(width, height))
        gl.enable_only(moderngl.DEPTH_TEST)
        gl.enable_direct(GL_CLIP_DISTANCE0)
        program = self.surface_programs[textured]
        set_uniforms(program, {"clip_from_world": view.clip_from_world().T})
        table: list[tuple[float, ...]] = [(0.0,) * 12]
        for item in members:
            self._draw_object(item, program, textured, table)
        gl.disable_direct(GL_CLIP_DISTANCE0)
        gl.enable_only(moderngl.NOTHING)
        target.surfaces.write(np.array(table[:MAX_SURFACES], dtype="f4"), viewport=(0, 0, 3, min(len(table), MAX_SURFACES)))
        return [row[7] for row in table[1:]] or [1.0]

    def _draw_object(self, placed: PlacedMesh, program: moderngl.Program, textured: bool,
                     table: list[tuple[float, ...]]) -> None:
        linear = placed.world_from_model[:3, :3]
        gl = self._context.gl
        gl.front_face = "cw" if np.linalg.det(linear) < 0 else "ccw"
        set_uniforms(program, {"world_from_model": placed.world_from_model.T,
                               "normal_from_model": np.linalg.inv(linear)})  # its transpose, in GL's column order
        for part in placed.mesh.parts:
            surface = placed.surface or part.surface
            if surface.double_sided:
                gl.disable(moderngl.CULL_FACE)
            else:
                gl.enable(moderngl.CULL_FACE)
            set_uniforms(program, {"surface_index": float(min(len(table), MAX_SURFACES - 1))})
            lobe = self._lobe_cells.get(quantized_roughness(surface.roughness), (0.0, 0.0, 0.0))
            table.append((*surface.base_color[:3], surface.metallic, *surface.emissive, surface.roughness, *lobe, 0.0))
            if textured:
                self._bind_textures(program, surface, NO_TEXTURES if placed.surface else part.textures)
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
        set_uniforms(program, {
            "has_textures": bits, "base_color": surface.base_color, "metallic": surface.metallic,
            "roughness": surface.roughness, "emissive": surface.emissive,
            "alpha_cutoff": -1.0 if surface.alpha_cutoff is None else surface.alpha_cutoff})

    def _shade(self, view: View, target: _ViewTarget, kind: Shading) -> None:
        program, triangle = self._shading_program(kind)
        target.shaded.use()
        target.shaded.viewport = (0, 0, *view.size)
        self._panorama.bind(program)
        textures = {"radiance_map": self._radiance_texture, "dfg_table": self._dfg, "lobe_atlas": self._lobe_atlas,
                    "surfaces": target.surfaces,
                    **({"ring_map": self._illumination.rings} if kind.rings and self._illumination else {}),
                    **dict(zip(("geometry", "color_metallic", "emissive_roughness"), target.samples, strict=False))}
        for unit, (name, texture) in enumerate(textures.items(), start=FIRST_UNIT):
            texture.use(unit)
            set_uniforms(program, {name: unit})
        left, right, bottom, top = view.bounds
        set_uniforms(program, {**self._uniforms, "world_from_view": view.rotation,  # GL reads rows as columns: the transpose
                               "view_bounds": (left, bottom, right - left, top - bottom), "view_size": view.size})
        triangle.render(moderngl.TRIANGLES, 3)

    def release(self) -> None:
        release_all(*itertools.chain(*self._targets.values()), self._lobe_atlas, self._dfg, *self.surface_programs.values())
        for program, triangle in self._shading.values():
            release_all(triangle, program)

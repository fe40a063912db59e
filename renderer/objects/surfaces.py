"""Draws what the objects' surfaces are into perspective views, 2 x 2 samples a pixel, and their silhouettes.

Shading while rasterising costs a software renderer one run of the shader for 4 x 4 pixels of every triangle, and its
multisampling more than drawing at twice the size. Surfaces stay as drawn for as long as nothing moves.
"""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from renderer.gl import GL_CLIP_DISTANCE0, Context, release_all, set_uniforms
from renderer.models.gpu_mesh import SLOTS, PlacedMesh
from renderer.models.mesh import Slot, Surface, TextureMapping
from renderer.objects.placement import View
from renderer.objects.silhouettes import SilhouetteView, silhouette_view

SAMPLES = 2               # a side of a pixel
SILHOUETTE_STEP = 256
SIZE_STEP = 64            # view targets come in a few sizes, so that moving objects do not allocate
NO_POWER_OF_TWO = 8       # added to them: llvmpipe compiles other programs for powers of two, in mid-stream when one first comes
MIRRORED_STEP = 64        # odd multiples for mirrored views: their mip levels 1 to 6 lose no texels
FIRST_UNIT = 8            # texture units after the panorama's
BELOW_NOTHING = -1e9
MAX_IDLE_PIXELS = 1_500_000  # of targets that no view uses, some 100 bytes each
MAX_SURFACES = 512
ALPHA_MODES = ("opaque", "mask", "blend")  # as in material.glsl


class Silhouette:
    """What a view's objects cover, in a texture that only grows."""

    def __init__(self, context: Context) -> None:
        self._context = context
        self.texture: moderngl.Texture | None = None
        self.framebuffer: moderngl.Framebuffer | None = None
        self._depth: moderngl.Renderbuffer | None = None     # where real things may hide objects
        self.projection: SilhouetteView | None = None

    def reserve(self, size: tuple[int, int], *, with_depth: bool) -> moderngl.Framebuffer:
        """A framebuffer of at least this size."""
        kept = (0, 0) if self.texture is None else self.texture.size
        if self.framebuffer is None or kept[0] < size[0] or kept[1] < size[1] or (with_depth and self._depth is None):
            self.release()
            width, height = (-(-max(pair) // SILHOUETTE_STEP) * SILHOUETTE_STEP + NO_POWER_OF_TWO
                             for pair in zip(size, kept, strict=True))
            self.texture = self._context.texture((width, height), 1, "f1")
            self.texture.build_mipmaps(0, 1)
            self.texture.filter = (moderngl.LINEAR_MIPMAP_NEAREST, moderngl.LINEAR)
            self._depth = self._context.gl.depth_renderbuffer((width, height)) if with_depth else None
            self.framebuffer = self._context.gl.framebuffer([self.texture], self._depth)
        return self.framebuffer

    def uv_from_tangent(self) -> NDArray[np.float64]:
        """(2, 3) from the view's tangent plane to the texture."""
        assert self.projection is not None
        assert self.texture is not None
        used = np.array(self.projection.size) / self.texture.size
        return np.asarray(self.projection.uv_from_tangent * used[:, None])

    def release(self) -> None:
        self._context.rest()
        release_all(self.framebuffer, self.texture, self._depth)


class ViewTarget:
    """Sample buffers of one size, the silhouette, and the shaded result. Detailed views have the surface in two more buffers."""

    def __init__(self, context: Context, size: tuple[int, int], detailed: bool) -> None:
        gl = context.gl
        sampled = (size[0] * SAMPLES, size[1] * SAMPLES)
        self.samples = [context.texture(sampled, 4, dtype, linear=False) for dtype in (["f4", "f2", "f2"] if detailed else ["f4"])]
        self._depth = gl.depth_renderbuffer(sampled)
        self.framebuffer = gl.framebuffer(self.samples, self._depth)
        self.silhouette = Silhouette(context)
        self.texture = context.texture(size, 4, "f2")
        self.shaded = gl.framebuffer([self.texture])
        self.view: View | None = None       # whose surfaces are in the samples
        self.surfaces: list[tuple[Surface, int]] = []   # from 1 in the samples; each with the index of its object
        self.used = 0                       # the greater the later
        self.pixels = size[0] * size[1]

    def release(self) -> None:
        release_all(self.framebuffer, self.shaded, self.texture, self.silhouette, *self.samples, self._depth)


class SurfaceStage:
    """Owns the programs that draw meshes and the view targets."""

    def __init__(self, context: Context) -> None:
        self._context = context
        self._targets: dict[tuple[int, int, bool, bool], list[ViewTarget]] = {}
        self._uses = itertools.count()
        self.programs = {
            f"{what}{' detailed' if detailed else ''}":
                context.program(f"{vertex}.vert.glsl", f"{what}.frag.glsl", {"DETAILED": int(detailed)})
            for what, vertex in (("surface", "surface"), ("mask", "mask")) for detailed in (False, True)}

    def set_ground(self, ground_y: float | None) -> None:
        """Hide what is below the ground from now on; None: there is no ground."""
        below = BELOW_NOTHING if ground_y is None else ground_y - 1e-4
        for program in self.programs.values():
            set_uniforms(program, {"clip_below_y": below})

    def drawn(self, view: View, members: list[PlacedMesh], occluders: tuple[PlacedMesh, ...] = (), *,
              outlined: bool = True) -> tuple[ViewTarget, bool]:
        """The view's target, its surfaces in it, and whether they had to be drawn anew. `occluders` are real things that hide
        them, themselves unseen. A mirrored view has no silhouette, nor has one that is not to be `outlined`."""
        detailed = any(item.is_detailed for item in members)
        target = self._target(view, detailed)
        if target.view is view:
            return target, False
        suffix = " detailed" if detailed else ""
        target.surfaces = [(surface, index) for index, item in zip(view.members, members, strict=True)
                           for _, surface in item.parts()][:MAX_SURFACES - 1]
        sampled = (view.size[0] * SAMPLES, view.size[1] * SAMPLES)
        set_uniforms(self.programs[f"surface{suffix}"], {"camera_y": view.camera_y})
        if view.mirror_y is not None:
            self._draw_mirrored(target.framebuffer, sampled, f"surface{suffix}", view, members, occluders)
            target.view = view
            return target, True
        self._draw(target.framebuffer, sampled, f"surface{suffix}", view.clip_from_world(), members, occluders)
        target.view = view
        if not outlined:
            return target, True
        outline = target.silhouette.projection = silhouette_view(view)
        framebuffer = target.silhouette.reserve(outline.size, with_depth=bool(occluders))
        self._draw(framebuffer, outline.size, f"mask{suffix}", outline.clip_from_world, members, occluders)
        assert target.silhouette.texture is not None
        target.silhouette.texture.build_mipmaps(0, 1)
        return target, True

    def draw_depth(self, clip_from_world: NDArray[np.float64], members: list[PlacedMesh]) -> None:
        """Draw objects into the depth of the framebuffer in use."""
        gl = self._context.gl
        gl.enable_only(moderngl.DEPTH_TEST)
        gl.enable_direct(GL_CLIP_DISTANCE0)
        for item in members:
            name = "mask detailed" if item.is_detailed else "mask"
            set_uniforms(self.programs[name], {"clip_from_world": clip_from_world.T})
            self._draw_object(item, name, self.programs[name], 1)
        gl.front_face = "ccw"
        gl.disable_direct(GL_CLIP_DISTANCE0)
        gl.enable_only(moderngl.NOTHING)

    def keep(self, views: list[View]) -> None:
        """Surfaces of these views stay as drawn until the views are others; the targets of all other views are free, and the first
        to have been is given up where they are too many."""
        kept = {id(view) for view in views}
        for target in itertools.chain(*self._targets.values()):
            if id(target.view) not in kept:
                target.view = None
        self._give_up_idle()

    def _give_up_idle(self) -> None:
        idle = sorted((target.used, key, target) for key, targets in self._targets.items()
                      for target in targets if target.view is None)
        pixels = sum(target.pixels for _, _, target in idle)
        for _, key, target in idle:
            if pixels <= MAX_IDLE_PIXELS:
                break
            pixels -= target.pixels
            self._targets[key].remove(target)
            self._context.rest()
            target.release()

    def _target(self, view: View, detailed: bool) -> ViewTarget:
        step, more = (SIZE_STEP, NO_POWER_OF_TWO) if view.mirror_y is None else (2 * MIRRORED_STEP, MIRRORED_STEP)
        width, height = (-(-side // step) * step + more for side in view.size)
        targets = self._targets.setdefault((width, height, detailed, view.mirror_y is not None), [])
        for target in targets:
            if target.view is view:
                target.used = next(self._uses)
                return target
        free = next((target for target in targets if target.view is None), None)
        if free is None:
            free = ViewTarget(self._context, (width, height), detailed)
            targets.append(free)
        free.used = next(self._uses)
        return free

    def _draw_mirrored(self, framebuffer: moderngl.Framebuffer, size: tuple[int, int], name: str, view: View,
                       members: list[PlacedMesh], occluders: tuple[PlacedMesh, ...]) -> None:
        """Real things hide objects in the mirror, and the mirror itself."""
        self._draw(framebuffer, size, name, replace(view, mirror_y=None).clip_from_world(), [], occluders)
        self._draw(framebuffer, size, name, view.clip_from_world(), members, occluders, mirrored=True)

    def _draw(self, framebuffer: moderngl.Framebuffer, size: tuple[int, int], name: str, clip_from_world: NDArray[np.float64],
              members: list[PlacedMesh], occluders: tuple[PlacedMesh, ...], *, mirrored: bool = False) -> None:
        """`mirrored`: over what is there, the world turned inside out."""
        gl, program = self._context.gl, self.programs[name]
        framebuffer.use()
        framebuffer.viewport = (0, 0, *size)
        if not mirrored:
            framebuffer.clear(0.0, 0.0, 0.0, 0.0, viewport=size)
        gl.enable_only(moderngl.DEPTH_TEST if occluders or name.startswith("surface") else moderngl.NOTHING)
        gl.enable_direct(GL_CLIP_DISTANCE0)
        set_uniforms(program, {"clip_from_world": clip_from_world.T})
        if occluders:
            _write_colors(framebuffer, False)
            for item in occluders:
                self._draw_object(item, name, program, 0, mirrored)
            _write_colors(framebuffer, True)
        index = 1
        for item in members:
            index = self._draw_object(item, name, program, index, mirrored)
        gl.front_face = "ccw"
        gl.disable_direct(GL_CLIP_DISTANCE0)
        gl.enable_only(moderngl.NOTHING)

    def _draw_object(self, placed: PlacedMesh, name: str, program: moderngl.Program, index: int, mirrored: bool = False) -> int:
        """Returns the index that follows those of its surfaces."""
        gl = self._context.gl
        gl.front_face = "cw" if placed.is_mirrored != mirrored else "ccw"
        placed.mesh.take_pose(placed.pose)
        set_uniforms(program, placed.matrices())
        for part, surface in placed.parts():
            if surface.double_sided or surface.alpha_mode == "blend":
                gl.disable(moderngl.CULL_FACE)
            else:
                gl.enable(moderngl.CULL_FACE)
            set_uniforms(program, {"surface_index": float(min(index, MAX_SURFACES - 1))})
            if name.endswith("detailed"):
                _bind_material(program, surface, {} if placed.surface else part.textures)
            part.vertex_arrays[name].render()
            index += 1
        return index

    def release(self) -> None:
        release_all(*itertools.chain(*self._targets.values()), *self.programs.values())


def _write_colors(framebuffer: moderngl.Framebuffer, on: bool) -> None:
    one: Any = (on, on, on, on)
    count = len(framebuffer.color_attachments)
    framebuffer.color_mask = one if count == 1 else (one,) * count
    framebuffer.use()       # moderngl hands the mask over only then


def _bind_material(program: moderngl.Program, surface: Surface, textures: dict[Slot, moderngl.Texture]) -> None:
    matrices, second_set, mirrored = np.zeros((len(SLOTS), 2, 3)), 0, [0, 0]
    for index, slot in enumerate(SLOTS):
        mapping = surface.mappings.get(slot, TextureMapping())
        matrices[index] = mapping.matrix
        second_set |= mapping.uv_set << index
        for axis in (0, 1):
            mirrored[axis] |= (mapping.wrap[axis] == "mirror") << index     # moderngl has no name for GL_MIRRORED_REPEAT
        set_uniforms(program, {f"{slot}_texture": FIRST_UNIT + index})
        if slot in textures:
            textures[slot].use(FIRST_UNIT + index)
    set_uniforms(program, {
        "has_textures": sum(1 << index for index, slot in enumerate(SLOTS) if slot in textures), "second_set": second_set,
        "mirrored": tuple(mirrored),
        "uv_mapping": matrices.transpose(0, 2, 1), "base_color": surface.base_color, "metallic": surface.metallic,
        "roughness": surface.roughness, "emissive": surface.emissive, "normal_scale": surface.normal_scale,
        "occlusion_strength": surface.occlusion_strength, "is_unlit": int(surface.unlit),
        "alpha_mode": ALPHA_MODES.index(surface.alpha_mode), "alpha_cutoff": surface.alpha_cutoff or 0.0})

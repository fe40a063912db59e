"""How much of each strong light reaches an object's surface past itself and its neighbours, for every pixel of a view.

A depth map along the light, looked up with a filter as wide as the light's disc is on the surface (Fernando 2005). Worked out
once for as long as neither objects nor light move; the shading of a frame then reads one texel.
"""

from __future__ import annotations

from dataclasses import dataclass
from weakref import WeakKeyDictionary

import moderngl
import numpy as np
from numpy.typing import NDArray

from renderer.gl import Context, release_all, set_uniforms
from renderer.light.detection import Light
from renderer.light.discs import hardly_moved
from renderer.models.gpu_mesh import PlacedMesh
from renderer.objects.near_field import Body
from renderer.objects.placement import View, looking_along
from renderer.objects.surfaces import FIRST_UNIT, SurfaceStage, ViewTarget

Array = NDArray[np.floating]
MAX_LIGHTS = 4             # in one view; a channel each
SIZE = 512                 # texels a side of a depth map
MIN_SHARE = 0.02           # of what all lights give; weaker ones go through
STALE = np.radians(1.0)     # how far a light may move before its shadows on objects are drawn anew
SETTLED_FRAMES = 8         # that it holds before it is drawn finely; at once when it is the first
_MARGIN = 1.02


@dataclass(frozen=True)
class Receiver:
    """An object, how its surroundings see it, and whether it throws shadows at all."""

    placed: PlacedMesh
    body: Body
    casts: bool


@dataclass
class _Kept:
    texture: moderngl.Texture
    framebuffer: moderngl.Framebuffer
    view: View
    casters: tuple[bytes, ...]
    lights: tuple[Light, ...]
    number: int = 0
    is_fine: bool = False
    frames: int = 0         # that it has held


class LightVisibilityStage:
    """Owns the depth map and the visibility of every view that needs one."""

    def __init__(self, context: Context, surfaces: SurfaceStage) -> None:
        self._context = context
        self._surfaces = surfaces
        gl = context.gl
        self._depth = gl.depth_texture((SIZE, SIZE))
        self._depth.compare_func = ""
        self._depth.filter = (moderngl.NEAREST, moderngl.NEAREST)
        self._depth.repeat_x = self._depth.repeat_y = False
        self._framebuffer = gl.framebuffer([], self._depth)
        self._programs = [context.program("full_screen.vert.glsl", "light_visibility.frag.glsl", {"FINE": fine})
                          for fine in (0, 1)]
        self._triangles = [gl.vertex_array(program, []) for program in self._programs]
        self._kept: WeakKeyDictionary[ViewTarget, _Kept] = WeakKeyDictionary()
        self._drawn = 0
        self.all_visible = context.texture((1, 1), 4, "f1", linear=False)
        self.all_visible.write(b"\xff\xff\xff\xff")

    def texture(self, target: ViewTarget, view: View, receivers: tuple[Receiver, ...],
                lights: tuple[Light, ...]) -> tuple[moderngl.Texture, int]:
        """A channel for each of the first `MAX_LIGHTS`: the share of it that is visible from the surface in a pixel of the view.
        The number is another one whenever the content is."""
        strong = lights[:MAX_LIGHTS]
        casters = tuple(_casters(view.members, receivers, light) if _matters(light, lights) else () for light in strong)
        if not any(casters):
            return self.all_visible, 0
        states = tuple(b"".join(receivers[index].placed.state() for index in indices) for indices in casters)
        kept = self._kept.get(target)
        if kept is not None and kept.view is view and kept.casters == states and len(kept.lights) == len(strong) and all(
                hardly_moved(before, now, least=STALE) for before, now in zip(kept.lights, strong, strict=True)):
            kept.frames += 1
            if kept.is_fine or kept.frames < SETTLED_FRAMES:
                return kept.texture, kept.number
            kept.is_fine = True
        elif kept is not None:
            kept.is_fine = False
        if kept is None:
            texture = self._context.texture(target.texture.size, 4, "f1", linear=False)
            kept = _Kept(texture, self._context.gl.framebuffer([texture]), view, states, strong, is_fine=True)
            self._kept[target] = kept
        kept.view, kept.casters, kept.lights = view, states, strong
        kept.number = self._drawn = self._drawn + 1
        kept.frames = 0
        kept.framebuffer.use()
        kept.framebuffer.clear(1.0, 1.0, 1.0, 1.0)
        for channel, (light, indices) in enumerate(zip(strong, casters, strict=True)):
            if indices:
                self._add(kept, target, channel, light, [receivers[i] for i in view.members], [receivers[i] for i in indices])
        return kept.texture, kept.number

    def _add(self, kept: _Kept, target: ViewTarget, channel: int, light: Light, seen: list[Receiver],
             casters: list[Receiver]) -> None:
        rotation = looking_along(-light.direction)
        low, high = _box(rotation, seen)
        nearest, farthest = _box(rotation, casters)
        # nothing is hidden beside the casters, whose margin is empty
        low[:2], high[:2] = np.maximum(low[:2], nearest[:2]), np.minimum(high[:2], farthest[:2])
        high[:2] = np.maximum(high[:2], low[:2] + 1e-6)
        low[2] = min(low[2], nearest[2])
        clip_from_world = np.eye(4)
        clip_from_world[:3, :3] = rotation * (2 / (high - low))[:, None]
        clip_from_world[:3, 3] = -(high + low) / (high - low)
        self._framebuffer.use()
        self._framebuffer.viewport = (0, 0, SIZE, SIZE)
        self._framebuffer.clear(depth=1.0)
        self._surfaces.draw_depth(clip_from_world, [item.placed for item in casters])
        # before it is used: moderngl 5.13 hands a mask to GL only then
        kept.framebuffer.color_mask = (channel == 0, channel == 1, channel == 2, channel == 3)
        kept.framebuffer.use()
        kept.framebuffer.viewport = (0, 0, *kept.view.size)
        self._depth.use(FIRST_UNIT)
        target.samples[0].use(FIRST_UNIT + 1)
        left, right, bottom, top = kept.view.bounds
        set_uniforms(self._programs[kept.is_fine], {
            "depth_map": FIRST_UNIT, "geometry": FIRST_UNIT + 1, "world_from_view": kept.view.axes, "camera_y": kept.view.camera_y,
            "view_bounds": (left, bottom, right - left, top - bottom), "view_size": kept.view.size,
            "clip_from_world": clip_from_world.T, "light_direction": light.direction,
            "extent": tuple(high - low), "spread": float(np.tan(light.angular_radius))})
        self._context.gl.enable_only(moderngl.NOTHING)
        self._triangles[kept.is_fine].render(moderngl.TRIANGLES, 3)
        kept.framebuffer.color_mask = (True, True, True, True)

    def reset(self) -> None:
        """Forget the lights: the next ones have nothing to do with them."""
        self._context.rest()
        for kept in self._kept.values():
            release_all(kept.framebuffer, kept.texture)
        self._kept.clear()

    def release(self) -> None:
        self.reset()
        release_all(self._framebuffer, self._depth, *self._triangles, *self._programs, self.all_visible)


def _matters(light: Light, lights: tuple[Light, ...]) -> bool:
    return float(light.irradiance.sum()) > MIN_SHARE * float(sum(other.irradiance.sum() for other in lights))


def _casters(members: tuple[int, ...], receivers: tuple[Receiver, ...], light: Light) -> tuple[int, ...]:
    """Indices of the objects that may hide a light from some of a view's members."""
    found = []
    for index, caster in enumerate(receivers):
        if caster.casts and any(_may_hide(caster, receivers[member], light) for member in members
                                if member != index or not caster.body.is_convex):
            found.append(index)
    return tuple(found)


def _may_hide(caster: Receiver, receiver: Receiver, light: Light) -> bool:
    if caster is receiver:
        return True
    towards = caster.body.solid.centre - receiver.body.solid.centre
    along = float(towards @ light.direction)
    reach = caster.body.solid.radius + receiver.body.solid.radius
    aside = float(np.linalg.norm(towards - along * light.direction))
    return along > -reach and aside < reach + max(along, 0.0) * np.tan(light.angular_radius)


def _box(rotation: Array, items: list[Receiver]) -> tuple[Array, Array]:
    """Low and high corner in the light's axes of the spheres around some objects."""
    centres = np.array([item.body.solid.centre for item in items]) @ rotation.T
    radii = _MARGIN * np.array([item.body.solid.radius for item in items])[:, None]
    return (centres - radii).min(axis=0), (centres + radii).max(axis=0)

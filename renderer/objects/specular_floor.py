"""Objects mirrored in a specular ground: the views that show them there, blurred as the ground's roughness has it.

A mirrored view shows the objects from the camera's mirror image below the ground, so depth, light and what they reflect are those
of the objects themselves. Where the floor shows one, it no longer shows the frame's own radiance from there; the composite swaps
the two, weighed by Schlick's reflectance (1994), whose value at right angles is `ground.specular`. A floor darker than its share of
what it should mirror is not that specular in truth, so less is taken from it. Left as they are: what objects reflect of the ground
and the light that the floor throws at them.

Roughness: a Gaussian as wide as a Beckmann lobe of alpha = roughness^2, whose slopes have a standard deviation of alpha / sqrt(2):
a facet turned by an angle turns the reflection by twice that in the plane of incidence and by 2 cos(incidence) across it. Seen
from the camera this shrinks by the share of the way that lies behind the floor, 0 at a contact. That share is taken from the mean
distance of what is mirrored nearby, and the blur from mip levels; the lobe's lean towards the horizon and its long tails are left
out. What the rough floor showed before is taken from the small radiance map of the last frame whose light was read, whatever the
roughness.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

import moderngl
import numpy as np
from numpy.typing import NDArray

from renderer.compositing.tile_views import cube_face_of_tiles
from renderer.gl import Context, release_all, set_uniforms
from renderer.objects.placement import MAX_VIEW_SIZE, NEAR_M, TILE, View, plan_views, touched_tiles
from renderer.objects.surfaces import ViewTarget
from renderer.scene import Ground

Array = NDArray[np.float64]
UP = np.array([0.0, 1.0, 0.0])
MAX_HALF_ANGLE = np.radians(68.0)  # of a mirrored view: it need not be as even as one of the objects themselves
MAX_FACE_HALF_ANGLE = np.radians(75.0)     # of a cube's face and what blurs into it: beyond, nearly all of a view is its rim
MAX_SPREAD = 0.3           # standard deviation in radians
COARSE_SPREAD = 0.03       # from here on half the resolution is enough
REACH = 2.5                # standard deviations that the blur reaches
LEVELS = 6                 # of mirrored pictures; see surfaces.py
REDUCTION = 4              # view pixels a side of a texel of distances; as in floor_distance.frag.glsl
FIRST_UNIT = 8             # texture units after the panorama's


def lobe_spread(roughness: float) -> float:
    """Standard deviation in radians by which reflected directions scatter in the plane of incidence."""
    return float(min(np.sqrt(2.0) * roughness**2, MAX_SPREAD))


def mirrored_views(outlines: list[Array], ground: Ground, ground_y: float, frame_size: tuple[int, int]) -> tuple[View, ...]:
    """Views of objects, given by their (n, 3) world outlines, in the ground at `ground_y` metres; none if it is not specular."""
    if not ground.catcher or ground.specular <= 0:
        return ()
    spread = lobe_spread(ground.roughness)
    grown = [_grown(points * (1, -1, 1) + (0, 2 * ground_y, 0), ground_y, spread) for points in outlines]
    seen = [index for index, points in enumerate(grown) if (points.min(axis=0) > 0).any() or (points.max(axis=0) < 0).any()]
    tiles = [touched_tiles(grown[index], frame_size) for index in seen]
    for mask in tiles:
        mask[:frame_size[1] // 2 // TILE] = False       # no ground there
    views = plan_views([grown[index] for index in seen], tiles, frame_size, MAX_HALF_ANGLE)
    views = [view if view.cube_axis < 0 else _own_tiles(view, frame_size, spread) for view in views]
    coarser = 2 if spread > COARSE_SPREAD else 1
    return tuple(replace(view, members=tuple(seen[member] for member in view.members), mirror_y=ground_y,
                         size=(-(-view.size[0] // coarser), -(-view.size[1] // coarser)), density=view.density / coarser,
                         depth_range=(NEAR_M, view.depth_range[1])) for view in views if view.tiles.any())


def _own_tiles(view: View, frame_size: tuple[int, int], spread: float) -> View:
    """A cube face as a view for those of its tiles whose middle it shows, wide enough to show all of them, and what blurs into
    them: one view a tile is all that the composite takes."""
    half = float(np.tan(min(np.pi / 4 + 1.5 * np.pi * TILE / frame_size[1] + REACH * spread, MAX_FACE_HALF_ANGLE)))
    size = tuple(min(int(np.ceil(side * half / view.bounds[1])), MAX_VIEW_SIZE) for side in view.size)
    return replace(view, bounds=(-half, half, -half, half), size=(size[0], size[1]), cube_axis=-1,
                   tiles=view.tiles & (cube_face_of_tiles(frame_size) == view.cube_axis))


def _grown(points: Array, ground_y: float, spread: float) -> Array:
    """(n, 3) or (9 n, 3) mirrored points and what bounds their blurred images."""
    if spread == 0:
        return points
    distance = np.linalg.norm(points, axis=1, keepdims=True)
    behind = np.clip(1 - ground_y / np.minimum(points[:, 1:2], ground_y), 0, 1)
    reach = REACH * spread * behind * distance
    direction = points / np.maximum(distance, 1e-9)
    right = np.cross(direction, UP) + np.array([1e-9, 0.0, 0.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    up = np.cross(right, direction)
    return np.concatenate([points + reach * (x * right + y * up) for x in (-1, 0, 1) for y in (-1, 0, 1)])


@dataclass(frozen=True)
class SpecularFloor:
    """What the composite needs: the views, what draws one (premultiplied radiance), the reflectance at right angles, and, for a
    rough floor, the small radiance map."""

    views: tuple[View, ...]
    picture: Callable[[View], moderngl.Texture]
    specular: float
    rough_radiance: moderngl.Texture | None


@dataclass
class _Blurred:
    """The picture of a view's target as a rough floor shows it."""

    texture: moderngl.Texture
    framebuffer: moderngl.Framebuffer
    distances: moderngl.Texture
    distance_target: moderngl.Framebuffer
    view: View | None = None
    shows: tuple[int, float] | None = None      # number of the picture; spread

    def release(self) -> None:
        release_all(self.framebuffer, self.texture, self.distance_target, self.distances)


class FloorBlurStage:
    """Owns the programs that blur mirrored views, and the blurred pictures."""

    def __init__(self, context: Context) -> None:
        self._context = context
        self._distance = context.program("full_screen.vert.glsl", "floor_distance.frag.glsl")
        self._blur = context.program("full_screen.vert.glsl", "floor_blur.frag.glsl")
        self._triangles = [context.gl.vertex_array(program, []) for program in (self._distance, self._blur)]
        self._blurred: WeakKeyDictionary[ViewTarget, _Blurred] = WeakKeyDictionary()

    def run(self, view: View, target: ViewTarget, number: int, spread: float) -> moderngl.Texture:
        """The target's picture, blurred by `spread` radians where the way behind the floor is long. `number`: another one for
        another picture."""
        if target not in self._blurred:
            self._blurred[target] = self._made(target)
        blurred = self._blurred[target]
        if blurred.view is not view:
            self._draw_distances(view, target, blurred)
        elif blurred.shows == (number, spread):
            return blurred.texture
        blurred.view, blurred.shows = view, (number, spread)
        target.texture.build_mipmaps(0, LEVELS)
        target.texture.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)
        self._draw_blurred(view, target, blurred, spread)
        return blurred.texture

    def _made(self, target: ViewTarget) -> _Blurred:
        texture = self._context.texture(target.texture.size, 4, "f2")
        width, height = (-(-side // REDUCTION) for side in target.texture.size)
        distances = self._context.texture((width, height), 2, "f4")
        gl = self._context.gl
        return _Blurred(texture, gl.framebuffer([texture]), distances, gl.framebuffer([distances]))

    def _draw_distances(self, view: View, target: ViewTarget, blurred: _Blurred) -> None:
        blurred.distance_target.use()
        target.samples[0].use(FIRST_UNIT)
        set_uniforms(self._distance, {"geometry": FIRST_UNIT, "view_size": view.size})
        self._context.gl.enable_only(moderngl.NOTHING)
        self._triangles[0].render(moderngl.TRIANGLES, 3)
        blurred.distances.build_mipmaps()
        blurred.distances.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)

    def _draw_blurred(self, view: View, target: ViewTarget, blurred: _Blurred, spread: float) -> None:
        assert view.mirror_y is not None
        blurred.framebuffer.use()
        blurred.framebuffer.viewport = (0, 0, *view.size)
        target.texture.use(FIRST_UNIT)
        blurred.distances.use(FIRST_UNIT + 1)
        left, right, bottom, top = view.bounds
        set_uniforms(self._blur, {
            "picture": FIRST_UNIT, "distances": FIRST_UNIT + 1, "world_from_view": view.rotation,
            "view_bounds": (left, bottom, right - left, top - bottom), "view_size": view.size, "spread": spread,
            "ground_y": view.mirror_y})
        self._context.gl.enable_only(moderngl.NOTHING)
        self._triangles[1].render(moderngl.TRIANGLES, 3)

    def release(self) -> None:
        release_all(*self._blurred.values(), *self._triangles, self._distance, self._blur)

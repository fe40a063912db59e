"""Shadows on real surfaces of any shape: those of the scene's `local_scene` with role `catcher`.

The surfaces are drawn into perspective views of the tiles that a shadow may reach, and each pixel gets the ratio of its irradiance
with and without the objects, as the ground does: lights by their visibility past the objects (`light_visibility.py`), the residual
by transfer vectors (Sloan 2002) of the objects as solids, less what these give back (`bounce.py`). Views, visibility and transfer
are kept for as long as nothing moves. Things with role `occluder` stand in these views too: where one is in front, the shadow
behind it, the ground's as well, is not seen.
"""

from __future__ import annotations

import itertools
import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import moderngl
import numpy as np
from numpy.typing import NDArray

from renderer.compositing.tile_views import views_of_tiles
from renderer.equirectangular import pixel_directions
from renderer.gl import Context, release_all, set_uniforms
from renderer.light.detection import MAX_LIGHTS, Light
from renderer.light.irradiance import irradiance
from renderer.models.shapes import KINDS
from renderer.objects.placement import TileMask, View
from renderer.objects.surfaces import FIRST_UNIT, SurfaceStage, ViewTarget
from renderer.shadows.light_visibility import LightVisibilityStage, Receiver
from renderer.shadows.shadow_reach import AMBIENT_REACH, SLACK, SurfaceTiles, surface_tiles

Array = NDArray[np.floating]
MAX_SOLIDS = 12            # as in solids.glsl
GIVING_BACK = 3            # of them; as in catcher.frag.glsl
MUCH = 3                   # times as many tiles as are needed any more: views are found anew
PATIENT_PIXELS = 60_000    # of views that are lit anew in one frame, where they may wait
NORMALS = (16, 32)         # rows and columns of the irradiance map


@dataclass(frozen=True, eq=False)
class CatcherLight:
    """What lights the real surfaces: (25, 3) coefficients of the radiance without the lights; the lights; of each object, by its
    index, (9, 3) coefficients of the radiance that it gives back, or None. `reference`: None for ratios; else the picture is
    1 - what is missing / this irradiance."""

    coefficients: Array
    lights: tuple[Light, ...]
    given_back: tuple[Array | None, ...]
    reference: Array | None = None

    def is_same(self, other: CatcherLight) -> bool:
        """Whether it is made of the very same arrays."""
        parts, others = ((one.coefficients, *one.lights, *one.given_back) for one in (self, other))
        return len(parts) == len(others) and all(map(operator.is_, parts, others)) and (
            (self.reference is None) == (other.reference is None))


@dataclass(frozen=True)
class CatcherLayer:
    """What the composite needs: the views, and what draws one (ratio times coverage, coverage), with another number for another
    picture."""

    views: tuple[View, ...]
    picture: Callable[[View], tuple[moderngl.Texture, int]]


@dataclass(frozen=True)
class _Reach:
    """The views of everything that a shadow may reach, with some slack for the lights; how many tiles it was without."""

    tiles: TileMask
    needed: int
    views: tuple[View, ...]


@dataclass
class _Picture:
    """What belongs to one view's target."""

    transfer: list[moderngl.Texture]
    transfer_target: moderngl.Framebuffer
    ratio: moderngl.Texture
    ratio_target: moderngl.Framebuffer
    moved: tuple[bytes, ...] = ()               # what the transfer was drawn for
    shown: tuple[int, int] | None = None        # numbers of the light and of its visibility that the ratio was drawn for
    number: int = 0                             # another for another picture

    def release(self) -> None:
        release_all(self.transfer_target, *self.transfer, self.ratio_target, self.ratio)


class CatcherStage:
    """Owns the programs and the pictures of all views of real surfaces."""

    def __init__(self, context: Context, frame_size: tuple[int, int], surfaces: SurfaceStage) -> None:
        self._context, self._frame_size, self._surfaces = context, frame_size, surfaces
        self._programs = {name: context.program("full_screen.vert.glsl", f"{name}.frag.glsl")
                          for name in ("catcher_transfer", "catcher")}
        self._triangles = {name: context.gl.vertex_array(program, []) for name, program in self._programs.items()}
        self._visibility = LightVisibilityStage(context, surfaces)
        self._ambient = context.texture(NORMALS[::-1], 4, "f4", wrap_x=True)
        self._normals = pixel_directions(*NORMALS)
        self._pictures: WeakKeyDictionary[ViewTarget, _Picture] = WeakKeyDictionary()
        self._drawings = itertools.count(1)
        self._reach: _Reach | None = None
        self._surfaces_of: tuple[bytes, ...] | None = None
        self._all = self._catchers = SurfaceTiles(np.zeros((0, 0, 3)), np.zeros((0, 0)))
        self._things: tuple[Receiver, ...] = ()
        self._catching = 0
        self._casters: tuple[Receiver, ...] = ()
        self._given_back: tuple[Array | None, ...] = ()
        self._light: CatcherLight | None = None
        self._light_number = 0
        self._left = np.inf         # pixels that may be lit anew in this frame

    def set_scene(self, catchers: Sequence[Receiver], occluders: Sequence[Receiver], objects: Sequence[Receiver],
                  light: CatcherLight, ground: TileMask) -> tuple[View, ...]:
        """Take over what stands where in one frame, and its light. `ground`: tiles that show the ground's shadows. Returns the
        views of all that may differ."""
        self._things, self._catching = (*catchers, *occluders), len(catchers)
        casting = [index for index, item in enumerate(objects) if item.casts]
        self._casters = tuple(objects[index] for index in casting)
        self._given_back = tuple(light.given_back[index] for index in casting)
        if self._light is None or not light.is_same(self._light):
            self._light_number += 1
            values = irradiance(light.coefficients, self._normals)
            self._ambient.write(np.pad(values, ((0, 0), (0, 0), (0, 1))).astype("f4").tobytes())
        self._light = light
        self._find_surfaces()
        kept, needed = self._reach, self._tiles(ground, 0.0)
        if kept is None or not (needed <= kept.tiles).all() or MUCH * needed.sum() < kept.needed:
            tiles = self._tiles(ground, SLACK)
            self._reach = kept = _Reach(tiles, int(needed.sum()), self._views(tiles))
        return kept.views

    def begin_frame(self, *, patient: bool) -> None:
        """`patient`: views for which only the light is another may wait, if others have had their turn since the last frame."""
        self._left = self._left if patient else np.inf

    def end_frame(self) -> None:
        """What is drawn from now on is for the next one."""
        self._left = PATIENT_PIXELS

    def draw_ahead(self, views: Sequence[View]) -> None:
        """Draw what the next frame needs, or some of it: what has waited longest first."""
        shown = {id(target.view): kept.shown or (0, 0) for target, kept in self._pictures.items()}
        for view in sorted(views, key=lambda view: shown.get(id(view), (0, 0))):
            self.picture(view)

    def _find_surfaces(self) -> None:
        """Where the frame shows real things, unless they stand as they stood."""
        state = (b"%d" % self._catching, *(item.placed.state() for item in self._things))
        if self._surfaces_of != state:
            self._surfaces_of, self._reach = state, None
            things = [(item.placed, item.body) for item in self._things]
            self._all, self._catchers = (surface_tiles(some, self._frame_size) for some in (things, things[:self._catching]))

    def _tiles(self, ground: TileMask, slack: float) -> TileMask:
        """Those that a shadow may reach."""
        assert self._light is not None
        tiles = self._all.shown & ground
        for caster in self._casters if self._catching else ():
            tiles = tiles | self._catchers.reached(caster.body, self._light.lights, slack)
        return tiles

    def _views(self, tiles: TileMask) -> tuple[View, ...]:
        farthest = float(np.nan_to_num(np.linalg.norm(self._all.places, axis=-1) + self._all.sizes).max(initial=1.0))
        return views_of_tiles(tiles, self._frame_size, farthest, tuple(range(len(self._things))))

    def picture(self, view: View) -> tuple[moderngl.Texture, int]:
        """(height, width, 4) ratio times coverage, and coverage, in the corner of a texture that the view fills; another number
        for another picture."""
        assert self._light is not None
        target, is_new = self._surfaces.drawn(view, [item.placed for item in self._things], outlined=False)
        moved = tuple(item.placed.state() for item in self._casters)
        kept = self._pictures.get(target)
        if kept is not None and not is_new and kept.moved == moved and self._left <= 0:
            return kept.ratio, kept.number
        visibility, number = self._visibility.texture(target, view, (*self._still(), *self._casters), self._light.lights)
        picture = self._pictures[target] = kept or self._new_picture(target)
        if is_new or picture.moved != moved:
            picture.moved = moved
            self._draw_transfer(picture, target, view)
        elif picture.shown == (self._light_number, number):
            return picture.ratio, picture.number
        picture.shown = (self._light_number, number)
        picture.number = next(self._drawings)
        self._left -= view.size[0] * view.size[1]
        self._draw_ratio(picture, target, view, visibility)
        return picture.ratio, picture.number

    def _still(self) -> tuple[Receiver, ...]:
        """The real things; their own shadows are in the frame already."""
        return tuple(Receiver(item.placed, item.body, casts=False) for item in self._things)

    def _new_picture(self, target: ViewTarget) -> _Picture:
        gl, size = self._context.gl, target.texture.size
        transfer = [self._context.texture(size, 4, "f2", linear=False) for _ in range(3)]
        ratio = self._context.texture(size, 4, "f2")
        return _Picture(transfer, gl.framebuffer(transfer), ratio, gl.framebuffer([ratio]))

    def _draw(self, name: str, target: moderngl.Framebuffer, geometry: ViewTarget, view: View,
              textures: dict[str, moderngl.Texture], values: dict[str, object]) -> None:
        target.use()
        target.viewport = (0, 0, *view.size)
        program = self._programs[name]
        for unit, (key, texture) in enumerate({"geometry": geometry.samples[0], **textures}.items(), start=FIRST_UNIT):
            texture.use(unit)
            set_uniforms(program, {key: unit})
        left, right, bottom, top = view.bounds
        catching = sum(index < self._catching for _, index in geometry.surfaces)
        set_uniforms(program, {"world_from_view": view.axes, "view_bounds": (left, bottom, right - left, top - bottom),
                               "view_size": view.size, "catcher_surfaces": catching, **values})
        self._triangles[name].render(moderngl.TRIANGLES, 3)

    def _draw_transfer(self, picture: _Picture, target: ViewTarget, view: View) -> None:
        kinds, spheres, matrices = np.zeros(MAX_SOLIDS), np.zeros((MAX_SOLIDS, 4)), np.zeros((MAX_SOLIDS, 4, 4))
        nearest = self._nearest(view)
        for slot, index in enumerate(nearest):
            solid = self._casters[index].body.solid
            kinds[slot], spheres[slot] = KINDS.index(solid.kind), (*solid.centre, solid.radius)
            matrices[slot] = solid.unit_from_world.T
        self._draw("catcher_transfer", picture.transfer_target, target, view, {}, {
            "solid_count": len(nearest), "solid_kind": kinds, "solid_sphere": spheres, "unit_from_world": matrices,
            "reach": AMBIENT_REACH})

    def _nearest(self, view: View) -> list[int]:
        """The casters nearest to where a view looks."""
        away = [1 - float(item.body.solid.centre @ view.rotation[2]) / max(float(np.linalg.norm(item.body.solid.centre)), 1e-6)
                for item in self._casters]
        return sorted(range(len(away)), key=away.__getitem__)[:MAX_SOLIDS]

    def _draw_ratio(self, picture: _Picture, target: ViewTarget, view: View, visibility: moderngl.Texture) -> None:
        assert self._light is not None
        directions, irradiances, radii = np.zeros((MAX_LIGHTS, 3)), np.zeros((MAX_LIGHTS, 3)), np.zeros(MAX_LIGHTS)
        for index, light in enumerate(self._light.lights[:MAX_LIGHTS]):
            directions[index], irradiances[index], radii[index] = light.direction, light.irradiance, light.angular_radius
        centres, given_back = np.zeros((GIVING_BACK, 3)), np.zeros((GIVING_BACK, 9, 3))
        for slot, index in enumerate(self._nearest(view)[:GIVING_BACK]):
            centres[slot] = self._casters[index].body.solid.centre
            given_back[slot] = 0.0 if self._given_back[index] is None else self._given_back[index]
        reference = self._light.reference
        self._draw("catcher", picture.ratio_target, target, view, {
            **{f"transfer_{index}": texture for index, texture in enumerate(picture.transfer)}, "light_visibility": visibility,
            "ambient_map": self._ambient}, {
            "has_light_visibility": int(visibility is not self._visibility.all_visible), "ambient_sh": self._light.coefficients[:9],
            "light_direction": directions, "light_irradiance": irradiances, "light_radius": radii,
            "light_count": min(len(self._light.lights), MAX_LIGHTS), "solid_centre": centres,
            "solid_count": min(len(self._casters), GIVING_BACK),
            "given_back": given_back, "reference": (0.0, 0.0, 0.0) if reference is None else tuple(reference)})

    def reset(self) -> None:
        """The next light has nothing to do with the last one."""
        self._visibility.reset()
        self._reach = None

    def release(self) -> None:
        self._context.rest()
        release_all(*self._pictures.values(), *self._triangles.values(), *self._programs.values(), self._visibility, self._ambient)

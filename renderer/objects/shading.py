"""Shades the surfaces in a view, once a pixel, by the light of the frame."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field, replace
from typing import NamedTuple
from weakref import WeakKeyDictionary

import moderngl
import numpy as np
from numpy.typing import NDArray

from renderer.gl import Context, release_all, set_uniforms
from renderer.light.detection import Light
from renderer.light.discs import share_below_horizon
from renderer.light.specular import MIN_ROUGHNESS, Array32, Lobe, dfg_table
from renderer.models.gpu_mesh import PlacedMesh
from renderer.models.mesh import Surface
from renderer.objects.lobe_atlas import LobeAtlas
from renderer.objects.mirrors import MirrorStage
from renderer.objects.near_field import Fit
from renderer.objects.placement import View
from renderer.objects.shading_turns import MIN_PIXELS, LitBy, Turns
from renderer.objects.surface_table import TABLE_WIDTH, reflected_solids, surface_rows
from renderer.objects.surfaces import FIRST_UNIT, MAX_SURFACES, SurfaceStage, ViewTarget
from renderer.panorama import PanoramaTextures
from renderer.quality import FULL
from renderer.shadows.ground_ratio import GroundRatioStage
from renderer.shadows.light_visibility import LightVisibilityStage, Receiver

Array = NDArray[np.float64]
LIGHT_SLOTS = (2, 4, 8)   # lights: each number has a program of its own, with a constant loop
MIRROR_BELOW = MIN_ROUGHNESS / 2


@dataclass(frozen=True)
class Illumination:
    """What lights the objects in one frame: irradiance by normal and radiance prefiltered for each roughness in use, both of
    the map without its lights; the lights; the ground's height (None: no ground); the frame with mip levels where the papers'
    rings stand in for the prefiltered maps."""

    irradiance: Array32
    lights: tuple[Light, ...]
    lobes: dict[float, Lobe]
    ground_y: float | None
    rings: moderngl.Texture | None = None
    near: tuple[Fit, ...] = ()      # of each object, by its index
    receivers: tuple[Receiver, ...] = ()    # the same
    occluders: tuple[Receiver, ...] = ()    # real things, which hide lights and objects
    number: int = 0                         # the same as long as only what casts shadows moves


class Shading(NamedTuple):
    """What an object's pixels need; each combination in use is a program of its own."""

    detailed: bool
    lights: int
    lobes: bool
    mirrors: bool
    reflects: bool      # what stands around
    rings: bool = False
    coat: bool = False


@dataclass
class _Shaded:
    """What the picture in a view's target was made from."""

    table: moderngl.Texture
    table_of: int | None = None             # number of the illumination
    turns: Turns = field(default_factory=Turns)
    rectangles: dict[int, tuple[int, int, int, int]] = field(default_factory=dict)      # of each object, by its index
    numbers: dict[int, int] = field(default_factory=dict)   # of each object, another for another picture of it

    apart: dict[int, int] = field(default_factory=dict)     # the numbers of mirrors' pictures without what they show of the frame

    def costs(self) -> dict[int, int]:
        """Pixels of each object's rectangle."""
        return {index: width * height for index, (_, _, width, height) in self.rectangles.items()}


class Drawn(NamedTuple):
    """A view's picture: premultiplied radiance, and its silhouette with (2, 3) from the view's tangent plane to it. `numbers`: of
    each member, another for another picture of it. `mirrors`: where pixels of mirrors look and how much of what is there they give
    back, where that is not in the picture; and which members are mirrors."""

    view: View
    numbers: tuple[int, ...]
    radiance: moderngl.Texture
    silhouette: moderngl.Texture
    silhouette_from_tangent: Array
    mirrors: tuple[moderngl.Texture, moderngl.Texture] | None
    mirroring: tuple[bool, ...]


def may_mirror(placed: PlacedMesh) -> bool:
    """Whether a part is smooth enough to show the frame itself."""
    return any(value < MIRROR_BELOW for value in placed.roughnesses)


def _pixels(view: View, placed: PlacedMesh) -> tuple[int, int, int, int]:
    """The rectangle of a view, x, y, width, height, that an object covers in it."""
    local = placed.outline() @ view.rotation.T
    if view.cube_axis >= 0 or view.mirror_y is not None or (local[:, 2] <= 0).any():
        return (0, 0, *view.size)
    left, right, bottom, top = view.bounds
    at = (local[:, :2] / local[:, 2:] - [left, bottom]) / [right - left, top - bottom] * view.size
    low, high = np.clip(np.floor(at.min(axis=0)) - 2, 0, view.size), np.clip(np.ceil(at.max(axis=0)) + 2, 0, view.size)
    return (int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1]))


def is_sharp(surface: Surface) -> bool:
    """Whether single things can be made out in what a surface reflects; as in shade.frag.glsl."""
    return surface.roughness < 0.6 and surface.metallic > 0.5


class ShadingStage:
    """Owns the shading programs and their look-up textures."""

    def __init__(self, context: Context, panorama: PanoramaTextures, surfaces: SurfaceStage,
                 radiance_texture: moderngl.Texture) -> None:
        self._context = context
        self._panorama = panorama
        self._surfaces = surfaces
        self._radiance_texture = radiance_texture
        self._shading: dict[Shading, tuple[moderngl.Program, moderngl.VertexArray]] = {}
        table = dfg_table()
        self._dfg = context.texture((table.shape[1], table.shape[0]), 2, "f4")
        self._dfg.write(table.tobytes())
        self._visibility = LightVisibilityStage(context, surfaces)
        self._mirrors = MirrorStage(context, panorama, radiance_texture)
        self.ground_missing = GroundRatioStage(context)
        self._shaded: WeakKeyDictionary[ViewTarget, _Shaded] = WeakKeyDictionary()
        self._pictures = itertools.count(1)
        self._lobes = LobeAtlas(context)
        self._uniforms: dict[str, object] = {}
        self._illumination: Illumination | None = None
        self.mirrors_apart = False  # whether what they show of the frame is left out of their pictures
        self.is_patient = False     # whether objects may wait a few frames for a light that has changed
        self.quality = FULL
        self._set_for: dict[Shading, View] = {}     # whose uniforms each program has
        self._slots = LIGHT_SLOTS[0]

    def _shading_program(self, kind: Shading) -> tuple[moderngl.Program, moderngl.VertexArray]:
        if kind not in self._shading:
            program = self._context.program("full_screen.vert.glsl", "shade.frag.glsl", {
                **self._panorama.defines, "DETAILED": int(kind.detailed), "LIGHTS": kind.lights,
                "HAS_LOBES": int(kind.lobes), "HAS_MIRRORS": int(kind.mirrors),
                "HAS_REFLECTIONS": int(kind.reflects), "HAS_RINGS": int(kind.rings),
                "HAS_COAT": int(kind.coat)})
            self._shading[kind] = (program, self._context.gl.vertex_array(program, []))
        return self._shading[kind]

    def set_illumination(self, illumination: Illumination) -> None:
        """Take over one frame's light."""
        self._illumination = illumination
        self._set_for.clear()
        lights = illumination.lights[:LIGHT_SLOTS[-1]]
        self._slots = next(slots for slots in LIGHT_SLOTS if slots >= len(lights))
        directions, irradiances, radii = np.zeros((self._slots, 3)), np.zeros((self._slots, 3)), np.zeros(self._slots)
        below = np.zeros(self._slots)
        if illumination.ground_y is not None and illumination.rings is None:    # the papers know no ground
            below[:len(lights)] = [share_below_horizon(light) for light in lights]
        for index, light in enumerate(lights):
            directions[index], irradiances[index], radii[index] = light.direction, light.irradiance, light.angular_radius
        self._lobes.fill(illumination.irradiance, illumination.lobes)
        self._uniforms = {
            **self._lobes.uniforms,
            "light_direction": directions, "light_irradiance": irradiances, "light_radius": radii,
            "light_below": below,
            "mirror_below": MIRROR_BELOW,
            "ground_y": illumination.ground_y or 0.0,
            "has_ground": int(illumination.ground_y is not None),
        }
        self._surfaces.set_ground(illumination.ground_y)

    @property
    def near(self) -> tuple[Fit, ...]:
        """The near field of each object in the light that was set last."""
        return () if self._illumination is None else self._illumination.near

    def set_receivers(self, receivers: tuple[Receiver, ...], occluders: tuple[Receiver, ...]) -> None:
        """The same objects as they stand now, under the same light."""
        self._set_for.clear()
        if self._illumination is not None:
            self._illumination = replace(self._illumination, receivers=receivers, occluders=occluders)

    def draw(self, view: View, objects: list[PlacedMesh]) -> Drawn:
        """Draw and shade the view's members."""
        target, _ = self.picture(view, objects)
        assert target.silhouette.texture is not None
        numbers = tuple(self._shaded[target].numbers.get(index, 0) for index in view.members)
        mirroring = tuple(self.mirrors_apart and may_mirror(objects[index]) for index in view.members)
        return Drawn(view, numbers, target.texture, target.silhouette.texture, target.silhouette.uv_from_tangent(),
                     self._mirrors.rays(target) if any(mirroring) else None, mirroring)

    def picture(self, view: View, objects: list[PlacedMesh]) -> tuple[ViewTarget, int]:
        """The target with the view's members drawn and shaded, and another number for another picture."""
        target, shaded = self._prepared(view, objects)
        visibility, lit_by = self._lit_by(view, target)
        due = shaded.turns.now(shaded.costs(), lit_by, patient=self.is_patient)
        due += [index for index in view.members if index not in due and self._has_rings]
        self._shade(view, target, visibility, objects, due)
        for index in view.members:
            if may_mirror(objects[index]) and not (self.mirrors_apart and shaded.apart.get(index) == shaded.numbers.get(index)):
                self._mirrors.show(target, view, shaded.rectangles[index], apart=self.mirrors_apart)
                shaded.numbers[index] = next(self._pictures)
                if self.mirrors_apart:
                    shaded.apart[index] = shaded.numbers[index]
        return target, max(shaded.numbers.values(), default=0)

    @property
    def is_behind(self) -> bool:
        """Whether objects wait for their turn to be shaded by the newest light."""
        return any(shaded.turns.is_behind for shaded in self._shaded.values())

    def draw_still(self, views: list[View], objects: list[PlacedMesh]) -> None:
        """Draw and shade, ahead of the next frame, what does not depend on it, or some of it; mirrors keep what they show."""
        prepared = sorted(((view, *self._prepared(view, objects)) for view in views), key=lambda one: -one[2].turns.waited)
        pixels = max(self.quality.shading_share * sum(sum(shaded.costs().values()) for _, _, shaded in prepared), MIN_PIXELS)
        for view, target, shaded in prepared:
            visibility, lit_by = self._lit_by(view, target)
            due = shaded.turns.ahead(shaded.costs(), lit_by, pixels if self.is_patient else np.inf)
            pixels -= sum(shaded.costs()[index] for index in due)
            self._shade(view, target, visibility, objects, due)

    def _lit_by(self, view: View, target: ViewTarget) -> tuple[moderngl.Texture, LitBy]:
        """What no mirror shows is the same for as long as light and surfaces are."""
        visibility, number = self._light_visibility(view, target)
        return visibility, (0 if self._illumination is None else self._illumination.number, number)

    def _prepared(self, view: View, objects: list[PlacedMesh]) -> tuple[ViewTarget, _Shaded]:
        """The view's target with its members' surfaces drawn, and how far it is shaded."""
        members = [objects[index] for index in view.members]
        hiding = () if self._illumination is None else self._illumination.occluders
        target, is_new = self._surfaces.drawn(view, members, tuple(item.placed for item in hiding))
        if target not in self._shaded:
            self._shaded[target] = _Shaded(self._context.texture((TABLE_WIDTH, MAX_SURFACES), 4, "f4", linear=False))
        shaded = self._shaded[target]
        number = None if self._illumination is None else self._illumination.number
        if is_new or shaded.table_of != number:
            near = () if self._illumination is None else self._illumination.near
            rows = surface_rows(target.surfaces, near, self._lobes)
            shaded.table.write(rows, viewport=(0, 0, TABLE_WIDTH, len(rows)))
            shaded.table_of = number
        if is_new:
            shaded.turns = Turns()
            shaded.rectangles = {index: _pixels(view, objects[index]) for index in view.members}
            target.shaded.use()
            target.shaded.clear()
        return target, shaded

    @property
    def _has_rings(self) -> bool:
        return self._illumination is not None and self._illumination.rings is not None

    def _kind(self, target: ViewTarget, item: PlacedMesh) -> Shading:
        """What an object's pixels need."""
        detailed = len(target.samples) > 1
        return Shading(
            detailed, self._slots, lobes=(detailed or max(item.roughnesses) >= MIRROR_BELOW) and bool(self._lobes),
            mirrors=may_mirror(item), rings=self._has_rings,
            # the papers reflect the distant frame alone, in mirrors too
            reflects=not self._has_rings and (item.is_detailed or any(map(is_sharp, item.surfaces))),
            coat=not self._has_rings and any(surface.clearcoat > 0 for surface in item.surfaces))

    def compile_variants(self, view: View, objects: list[PlacedMesh]) -> None:
        """Shade a view that has been drawn, once with each program that undetailed objects may need."""
        illumination = self._illumination
        if illumination is None:
            return
        target, shaded = self._prepared(view, objects)
        for slots in LIGHT_SLOTS:
            self.set_illumination(replace(illumination, lights=(Light(np.array([0.0, 1.0, 0.0]), np.ones(3), 0.01),) * slots))
            for lobes, mirrors, reflects in ((True, False, False), (True, False, True), (False, True, True)):
                self._shade_one(view, target, Shading(False, slots, lobes, mirrors, reflects), self._visibility.all_visible,
                                view.members[0], (0, 0, *view.size))
                if mirrors:
                    for apart in (False, True):
                        self._mirrors.show(target, view, (0, 0, *view.size), apart=apart)
        self.set_illumination(illumination)
        shaded.turns = Turns()

    def _light_visibility(self, view: View, target: ViewTarget) -> tuple[moderngl.Texture, int]:
        light = self._illumination
        if light is None or not light.receivers:
            return self._visibility.all_visible, 0
        return self._visibility.texture(target, view, (*light.receivers, *light.occluders), light.lights)

    def _shade(self, view: View, target: ViewTarget, visibility: moderngl.Texture, objects: list[PlacedMesh],
               due: list[int]) -> None:
        shaded = self._shaded[target]
        for index in due:
            self._shade_one(view, target, self._kind(target, objects[index]), visibility, index, shaded.rectangles[index])
            shaded.numbers[index] = next(self._pictures)

    def _shade_one(self, view: View, target: ViewTarget, kind: Shading, visibility: moderngl.Texture, member: int,
                   rectangle: tuple[int, int, int, int]) -> None:
        """One object of a view, which lies in a rectangle of it."""
        rows = [row for row, (_, index) in enumerate(target.surfaces, start=1) if index == member]
        if not rows:        # too many surfaces in one view
            return
        program, triangle = self._shading_program(kind)
        framebuffer = self._mirrors.framebuffer(target, view) if kind.mirrors else target.shaded
        framebuffer.use()
        framebuffer.viewport = (0, 0, *view.size)
        self._panorama.bind(program)
        textures = {"radiance_map": self._radiance_texture, "dfg_table": self._dfg, "lobe_atlas": self._lobes.texture,
                    "surfaces": self._shaded[target].table, "light_visibility": visibility,
                    "ground_missing": self.ground_missing.texture,
                    **({"ring_map": self._illumination.rings} if kind.rings and self._illumination else {}),
                    **dict(zip(("geometry", "color_metallic", "emissive_roughness"), target.samples, strict=False))}
        for unit, texture in enumerate(textures.values(), start=FIRST_UNIT):
            texture.use(unit)
        if self._set_for.get(kind) is not view:
            self._set_for[kind] = view
            self._set_uniforms(program, view, {name: unit for unit, name in enumerate(textures, start=FIRST_UNIT)})
        set_uniforms(program, {"ground_missing_rect": self.ground_missing.rect, "surface_range": (min(rows), max(rows)),
                               "has_light_visibility": int(visibility is not self._visibility.all_visible)})
        framebuffer.scissor = rectangle
        triangle.render(moderngl.TRIANGLES, 3)
        framebuffer.scissor = (0, 0, *target.texture.size)

    def _set_uniforms(self, program: moderngl.Program, view: View, units: dict[str, int]) -> None:
        """All that is the same for the objects of a view."""
        left, right, bottom, top = view.bounds
        receivers = () if self._illumination is None else self._illumination.receivers
        set_uniforms(program, {**units, **reflected_solids(receivers, view.members, self._lobes), **self._uniforms,
                               "world_from_view": view.axes,  # GL reads rows as columns: the transpose
                               "camera_y": view.camera_y,
                               "view_bounds": (left, bottom, right - left, top - bottom), "view_size": view.size})

    def reset(self) -> None:
        """The next light has nothing to do with the last one."""
        self._visibility.reset()
        self.ground_missing.reset()
        for shaded in self._shaded.values():
            shaded.turns = Turns()

    def release(self) -> None:
        release_all(*(shaded.table for shaded in self._shaded.values()), self._lobes, self._dfg, self._visibility,
                    self.ground_missing, self._mirrors)
        for program, triangle in self._shading.values():
            release_all(triangle, program)

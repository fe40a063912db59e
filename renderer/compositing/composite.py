"""Composites the touched tiles of a frame and writes them back; every other pixel keeps its codes.

Tiles are drawn side by side into an atlas, read back in one piece and scattered into the caller's planes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from renderer.compositing.coverage import PERSPECTIVE, CoverageStage, points_array
from renderer.compositing.tile_plan import ATLAS_COLUMNS, POINT_INTS, SLOTS, Batch, TilePlan, make_plan
from renderer.frame import RadianceFrame, RgbFrame, YuvFrame
from renderer.gl import Context, release_all, set_uniforms
from renderer.objects.placement import TILE, TileMask, View
from renderer.objects.shading import Drawn
from renderer.objects.specular_floor import SpecularFloor
from renderer.panorama import PanoramaTextures
from renderer.shadows.catchers import CatcherLayer
from renderer.shadows.shadow_atlas import ShadowAtlases, ShadowMap

Array = NDArray[np.float64]
MAX_SHADOWS = 64               # of each kind in one frame; as in composite.vert.glsl
FIRST_UNIT = 16           # after those of the object stage, which draws in between

DrawView = Callable[[View], Drawn]


class Output(Enum):
    """What is drawn for each pixel: Y'CbCr codes, radiance, the layers of `kept_layers.py`, or where mirrors look."""

    CODES = 0
    RADIANCE = 1
    LAYERS = 2
    MIRRORS = 3

    @property
    def textures(self) -> tuple[str, ...]:
        """Types of the atlases, four components each."""
        return {Output.CODES: ("f1", "f1"), Output.RADIANCE: ("f4",), Output.LAYERS: ("f2", "f2"),
                Output.MIRRORS: ("f4", "f4")}[self]

    @property
    def shader(self) -> str:
        """The file."""
        return "mirrored_pixels.frag.glsl" if self is Output.MIRRORS else "composite.frag.glsl"


NO_VIEW, CUBE_FACE = 0, 2      # beside PERSPECTIVE, as in composite.frag.glsl
# kind of view; maps of lights, and of the residual; additive; with a specular floor; with catchers
Variant = tuple[int, int, int, bool, bool, bool]


@dataclass(frozen=True)
class GroundLight:
    """What the ground receives without objects: in total, and from each light by index. `additive`: what is missing is subtracted
    as MR360 has it, with the frame as albedo (section 6.4)."""

    y: float
    total: Array
    lights: list[Array]
    additive: bool = False


class CompositeStage:
    """Owns the composite program and its output atlases for one source geometry."""

    def __init__(self, context: Context, panorama: PanoramaTextures, output: Output) -> None:
        self._context = context
        self._panorama = panorama
        self._output = output
        self._fragments = TILE // 2 if output is Output.CODES else TILE     # a side of a tile
        self._programs: dict[Variant, moderngl.Program] = {}
        self._vertex_arrays: dict[Variant, moderngl.VertexArray] = {}
        self._last_plan: TilePlan | None = None
        self._last_drawn: Drawn | None = None
        self._additive = False
        self._floor: SpecularFloor | None = None
        self._catchers: CatcherLayer | None = None
        self._pictures: list[moderngl.Texture] = []     # of the floor's views
        self._ratios: list[moderngl.Texture] = []       # of the catchers'
        self._rows = 0
        self._textures: list[moderngl.Texture] = []
        self._framebuffer: moderngl.Framebuffer | None = None
        self._points = context.gl.buffer(reserve=4 * POINT_INTS * 256)
        self._coverage = CoverageStage(context, panorama.size, FIRST_UNIT + 3, in_fours=output is Output.CODES)

    def run(self, views: list[View], draw_view: DrawView, maps: list[ShadowMap], ambient: list[ShadowMap],
            ground: GroundLight, atlases: ShadowAtlases, floor: SpecularFloor | None = None,
            catchers: CatcherLayer | None = None, only: TileMask | None = None) -> NDArray[np.intp]:
        """Draw every touched tile into the atlas, or `only` some. Returns the (n, 2) row and column of each, in atlas order."""
        maps = sorted(maps, key=lambda shadow: shadow.light)[:MAX_SHADOWS]
        ambient = ambient[:MAX_SHADOWS]
        others = (() if floor is None else floor.views, () if catchers is None else catchers.views)
        plan = self._plan(views, maps, ambient, others, only)
        if not len(plan.tiles):
            return plan.tiles
        self._reserve(len(plan.tiles))
        self._additive = ground.additive
        self._floor, self._catchers = floor, catchers
        self._frame_uniforms = self._constants(maps, ambient, ground)
        self._prepared: set[Variant] = set()
        atlases.lights.use(FIRST_UNIT + 1)
        atlases.ambient.use(FIRST_UNIT + 2)
        # all views first: reading a texture that has just been drawn makes a software renderer wait for it
        drawn = [draw_view(view) for view in views]
        self._pictures = [] if floor is None else [floor.picture(view) for view in floor.views]
        self._ratios = [] if catchers is None else [catchers.picture(view)[0] for view in catchers.views]
        assert self._framebuffer is not None
        self._context.gl.enable_only(moderngl.PROGRAM_POINT_SIZE)
        self._coverage.use(drawn)
        self._framebuffer.use()
        self._last_drawn = next(iter(drawn), None)
        for view, batches in zip([*drawn, None], plan.batches, strict=True):
            self._draw(batches, view)
        self._context.gl.enable_only(moderngl.NOTHING)
        return plan.tiles

    def compile_variants(self) -> None:
        """Draw a tile of the last frame with every program that objects without cube faces need."""
        assert self._framebuffer is not None
        self._framebuffer.use()
        self._context.gl.enable_only(moderngl.PROGRAM_POINT_SIZE)
        for view in (None, self._last_drawn):
            self._draw([Batch(slots, mirrored, -1, 0, 1) for slots in SLOTS for mirrored in range(-1, min(len(self._pictures), 1))],
                       view)
        self._context.gl.enable_only(moderngl.NOTHING)

    @property
    def _outputs(self) -> dict[str, int]:
        return {"OUTPUT_YUV": int(self._output is Output.CODES), "OUTPUT_LAYERS": int(self._output is Output.LAYERS)}

    def _plan(self, views: list[View], maps: list[ShadowMap], ambient: list[ShadowMap], others: tuple[tuple[View, ...], ...],
              only: TileMask | None) -> TilePlan:
        """Which tiles are drawn with what; kept for as long as all masks are the same arrays. `others`: the mirrored views, and
        those of catchers."""
        masks = [view.tiles for view in (*views, *(view for group in others for view in group))]
        masks += [shadow.tiles for shadow in (*maps, *ambient)]
        sizes = (len(views), len(maps), *map(len, others))
        kept = self._last_plan
        if kept is not None and kept.sizes == sizes and len(kept.masks) == len(masks) and all(
                a is b for a, b in zip(kept.masks, masks, strict=True)) and _same(kept.only, only):
            return kept
        plan = self._last_plan = make_plan(views, maps, ambient, others, masks, sizes, only)
        self._upload(plan.points)
        return plan

    def _upload(self, points: NDArray[np.int32]) -> None:
        if self._points.size < points.nbytes:
            release_all(*self._vertex_arrays.values())
            self._vertex_arrays.clear()
            self._points.orphan(2 * points.nbytes)
        self._points.write(points)

    def _reserve(self, count: int) -> None:
        rows = -(-count // ATLAS_COLUMNS)
        if rows > self._rows:
            self._release_target()
            self._rows = -(-rows // 8) * 8
            size = (ATLAS_COLUMNS * self._fragments, self._rows * self._fragments)
            self._textures = [self._context.texture(size, 4, dtype) for dtype in self._output.textures]
            self._framebuffer = self._context.gl.framebuffer(self._textures)

    def _variant(self, variant: Variant) -> tuple[moderngl.Program, moderngl.VertexArray]:
        if variant not in self._programs:
            view, maps, ambients, additive, floor, catchers = variant
            self._programs[variant] = self._context.program("composite.vert.glsl", self._output.shader, {
                **self._panorama.defines, **self._outputs, "VIEW": view,
                "MAPS": maps, "AMBIENTS": ambients, "COVERAGE": 0, "ADDITIVE": int(additive),
                "FLOOR": int(floor), "CATCHERS": int(catchers)})
        program = self._programs[variant]
        if variant not in self._vertex_arrays:
            self._vertex_arrays[variant] = points_array(self._context, program, self._points)
        return program, self._vertex_arrays[variant]

    def _constants(self, maps: list[ShadowMap], ambient: list[ShadowMap], ground: GroundLight) -> dict[str, object]:
        assert self._framebuffer is not None
        values: dict[str, object] = {
            "view_texture": FIRST_UNIT, "shadow_atlas": FIRST_UNIT + 1, "ambient_atlas": FIRST_UNIT + 2,
            "coverage": FIRST_UNIT + 3,
            "atlas_size": self._framebuffer.size, "tile_fragments": self._fragments, "tile_pixels": TILE,
            "atlas_columns": ATLAS_COLUMNS}
        if self._output is Output.CODES:
            values["yuv_from_rgb"] = self._panorama.format.yuv_from_rgb().T
        rects = np.zeros((4, MAX_SHADOWS, 4))
        for kind, shadows in ((0, maps), (2, ambient)):
            for index, item in enumerate(shadows):
                rects[kind, index] = item.scaled_rect()
                rects[kind + 1, index] = (*item.cell, max(item.light, 0))
        lights = np.zeros((8, 3))
        lights[:len(ground.lights)] = np.reshape(ground.lights, (-1, 3))
        return values | {"ground_y": ground.y, "ground_irradiance": tuple(ground.total), "light_on_ground": lights,
                         "map_rect": rects[0], "map_cell": rects[1], "ambient_rect": rects[2], "ambient_cell": rects[3]}

    def _draw(self, batches: list[Batch], drawn: Drawn | None) -> None:
        kind = NO_VIEW if drawn is None else PERSPECTIVE if drawn.view.cube_axis < 0 else CUBE_FACE
        for batch in batches:
            variant = (kind, *batch.slots, self._additive, batch.mirrored >= 0, batch.catcher >= 0)
            program, vertex_array = self._variant(variant)
            self._panorama.bind(program)
            if variant not in self._prepared:
                self._prepared.add(variant)
                set_uniforms(program, self._frame_uniforms)
            if drawn is not None:
                _bind_view(program, drawn)
            if self._floor is not None and batch.mirrored >= 0:
                _bind_floor(program, self._floor, batch.mirrored, self._pictures[batch.mirrored])
            if self._catchers is not None and batch.catcher >= 0:
                _bind_catchers(program, self._catchers.views[batch.catcher], self._ratios[batch.catcher])
            vertex_array.render(moderngl.POINTS, vertices=batch.points, first=batch.first)

    def tiles(self, count: int, attachment: int) -> NDArray[Any]:
        """(count, fragments, fragments, 4) tiles of an atlas."""
        f = self._fragments
        pixels = self._atlas(count, attachment)
        return pixels.reshape(-1, f, ATLAS_COLUMNS, f, 4).transpose(0, 2, 1, 3, 4).reshape(-1, f, f, 4)[:count]

    def _atlas(self, count: int, attachment: int) -> NDArray[np.generic]:
        """(height, width, 4) all rows of an atlas that hold the first `count` tiles."""
        assert self._framebuffer is not None
        width, height = ATLAS_COLUMNS * self._fragments, -(-count // ATLAS_COLUMNS) * self._fragments
        dtype = self._output.textures[attachment]
        data = self._framebuffer.read(viewport=(0, 0, width, height), components=4, attachment=attachment, alignment=1, dtype=dtype)
        return np.frombuffer(data, {"f1": "u1", "f2": "f2", "f4": "f4"}[dtype]).reshape(height, width, 4)

    def layers(self, count: int) -> tuple[NDArray[np.float16], NDArray[np.float16]]:
        """The atlases with the layers of the first `count` tiles."""
        factors, addends = (self._atlas(count, attachment).astype(np.float16, copy=False) for attachment in (0, 1))
        return factors, addends

    def write_yuv(self, frame: YuvFrame, tiles: NDArray[np.integer]) -> None:
        """Put the tiles into the planes, in place."""
        if not len(tiles):
            return
        half = TILE // 2
        luma = self.tiles(len(tiles), 0).reshape(-1, half, half, 2, 2).transpose(0, 1, 3, 2, 4).reshape(-1, TILE, TILE)
        chroma = self.tiles(len(tiles), 1)
        _scatter(frame.y, luma, tiles)
        _scatter(frame.u, chroma[..., 0], tiles)
        _scatter(frame.v, chroma[..., 1], tiles)

    def touched_radiance(self, tiles: NDArray[np.integer], frame: RgbFrame | RadianceFrame) -> tuple[NDArray[np.float32],
                                                                                                   NDArray[np.bool_]]:
        """(height, width, 3) composited radiance, zero where untouched, and the (height, width) mask of touched pixels."""
        height, width = frame.rgb.shape[:2]
        radiance = np.zeros((height, width, 4), dtype=np.float32)
        if len(tiles):
            _scatter(radiance, self.tiles(len(tiles), 0), tiles)
        return radiance[..., :3], radiance[..., 3] > 0.5

    def _release_target(self) -> None:
        self._context.rest()
        release_all(self._framebuffer, *self._textures)

    def release(self) -> None:
        self._release_target()
        release_all(*self._vertex_arrays.values(), *self._programs.values(), self._points)
        self._coverage.release()


def _same(one: TileMask | None, other: TileMask | None) -> bool:
    return one is other or (one is not None and other is not None and np.array_equal(one, other))


def _bind_view(program: moderngl.Program, drawn: Drawn) -> None:
    view = drawn.view
    drawn.radiance.use(FIRST_UNIT)
    if drawn.mirrors is not None:
        named = zip(("mirror_ray", "mirror_share"), drawn.mirrors, strict=True)
        for unit, (name, texture) in enumerate(named, start=FIRST_UNIT + 7):
            texture.use(unit)
            set_uniforms(program, {name: unit})
    left, right, bottom, top = view.bounds
    set_uniforms(program, {
        "view_axis": view.rotation[2], "view_from_world": view.rotation.T,
        "view_bounds": (left, bottom, 1 / (right - left), 1 / (top - bottom)),
        "view_scale": (view.size[0] / drawn.radiance.width, view.size[1] / drawn.radiance.height)})


def _bind_floor(program: moderngl.Program, floor: SpecularFloor, index: int, picture: moderngl.Texture) -> None:
    view = floor.views[index]
    picture.use(FIRST_UNIT + 4)
    if floor.rough_radiance is not None:
        floor.rough_radiance.use(FIRST_UNIT + 5)
    left, right, bottom, top = view.bounds
    set_uniforms(program, {
        "floor_texture": FIRST_UNIT + 4, "floor_rough_radiance": FIRST_UNIT + 5, "floor_from_world": view.rotation.T,
        "floor_bounds": (left, bottom, 1 / (right - left), 1 / (top - bottom)),
        "floor_scale": (view.size[0] / picture.width, view.size[1] / picture.height),
        "floor_specular": floor.specular, "floor_is_rough": int(floor.rough_radiance is not None)})


def _bind_catchers(program: moderngl.Program, view: View, ratio: moderngl.Texture) -> None:
    ratio.use(FIRST_UNIT + 6)
    left, right, bottom, top = view.bounds
    set_uniforms(program, {
        "catcher_texture": FIRST_UNIT + 6, "catcher_from_world": view.rotation.T,
        "catcher_bounds": (left, bottom, 1 / (right - left), 1 / (top - bottom)),
        "catcher_scale": (view.size[0] / ratio.width, view.size[1] / ratio.height)})


def _scatter(plane: NDArray[np.generic], blocks: NDArray[np.generic], tiles: NDArray[np.integer]) -> None:
    """Write (n, size, size, ...) blocks to their tiles of a plane; tiles at the far edges are cut."""
    size = blocks.shape[1]
    rows, columns = plane.shape[0] // size, plane.shape[1] // size
    whole = (tiles[:, 0] < rows) & (tiles[:, 1] < columns)
    down, across = plane.strides[:2]
    grid = np.lib.stride_tricks.as_strided(plane, (rows, columns, size, size, *plane.shape[2:]),
                                           (down * size, across * size, *plane.strides))
    grid[tiles[whole, 0], tiles[whole, 1]] = blocks[whole]
    for index in np.flatnonzero(~whole):
        row, column = tiles[index] * size
        target = plane[row:row + size, column:column + size]
        target[...] = blocks[index][:target.shape[0], :target.shape[1]]

"""Composites the touched tiles of a frame and writes them back; every other pixel keeps its codes.

Tiles are drawn side by side into an atlas, read back in one piece and scattered into the caller's planes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import moderngl
import numpy as np
from numpy.typing import NDArray

from renderer.frame import RadianceFrame, RgbFrame, YuvFrame
from renderer.gl import Context, release_all, set_uniforms
from renderer.panorama import PanoramaTextures
from renderer.placement import TILE, TileMask, View
from renderer.shading import Drawn
from renderer.shadows import ShadowMap, ShadowStage
from renderer.specular_floor import SpecularFloor

Array = NDArray[np.float64]
# Maps of lights and of the residual in one tile: each pair has a program of its own, and a tile takes the first that is enough.
# Few, because each has to be compiled before the first frame.
SLOTS = ((0, 1), (1, 1), (2, 2), (8, 4))
MAX_SHADOWS = 64               # of each kind in one frame; as in composite.vert.glsl
POINT_LAYOUT = (("tile", 3), ("maps_low", 4), ("maps_high", 4), ("ambients", 4), ("coverage_slot", 1))
POINT_INTS = sum(count for _, count in POINT_LAYOUT)
ATLAS_COLUMNS = 32
FIRST_UNIT = 16           # after those of the object stage, which draws in between

DrawView = Callable[[View], Drawn]
NO_VIEW, PERSPECTIVE, CUBE_FACE = 0, 1, 2     # as in composite.frag.glsl
Batch = tuple[tuple[int, int], int, int, int]     # of SLOTS; mirrored view or -1; first point and number of points
Variant = tuple[int, int, int, bool, bool]   # kind of view; light maps; maps of the residual; additive; with a specular floor


@dataclass(frozen=True)
class GroundLight:
    """What the ground receives without objects: in total, and from each light by index. `additive`: what is missing is subtracted
    as MR360 has it, with the frame as albedo (section 6.4)."""

    y: float
    total: Array
    lights: list[Array]
    additive: bool = False


@dataclass(frozen=True)
class Touched:
    """Tiles of one shadow map."""

    shadow: ShadowMap
    tiles: TileMask


@dataclass(frozen=True)
class _Plan:
    """Touched tiles in atlas order, the points to draw, and per view (the last entry: no view) which with each program."""

    tiles: NDArray[np.intp]
    points: NDArray[np.int32]
    batches: list[list[Batch]]
    view_points: list[tuple[int, int]]      # first and number of the points of each view that has any
    covered: int                            # tiles of all views together
    masks: list[TileMask]
    sizes: tuple[int, int, int]     # views, light maps, mirrored views


class CompositeStage:
    """Owns the composite program and its output atlas for one source geometry."""

    def __init__(self, context: Context, panorama: PanoramaTextures) -> None:
        self._context = context
        self._panorama = panorama
        self._is_yuv = panorama.kind is YuvFrame
        self._fragments = TILE // 2 if self._is_yuv else TILE
        self._programs: dict[Variant, moderngl.Program] = {}
        self._vertex_arrays: dict[Variant, moderngl.VertexArray] = {}
        self._last_plan: _Plan | None = None
        self._last_drawn: Drawn | None = None
        self._additive = False
        self._floor: SpecularFloor | None = None
        self._pictures: list[moderngl.Texture] = []     # of its views
        self._rows = 0
        self._textures: list[moderngl.Texture] = []
        self._framebuffer: moderngl.Framebuffer | None = None
        self._points = context.gl.buffer(reserve=4 * POINT_INTS * 256)
        self._coverage_program = context.program("composite.vert.glsl", "coverage.frag.glsl", {
            "OUTPUT_YUV": int(self._is_yuv), "VIEW": PERSPECTIVE, "MAPS": 0, "AMBIENTS": 0, "COVERAGE": 1})
        set_uniforms(self._coverage_program, {"frame_size": panorama.size, "tile_fragments": self._fragments, "tile_pixels": TILE,
                                              "atlas_columns": ATLAS_COLUMNS})
        self._coverage_array: moderngl.VertexArray | None = None
        self._covered: list[View] = []      # the views whose coverage is in the atlas
        self._make_coverage(8)

    def run(self, views: list[View], draw_view: DrawView, maps: list[Touched], ambient: list[Touched],
            ground: GroundLight | None, shadows: ShadowStage, floor: SpecularFloor | None = None) -> NDArray[np.intp]:
        """Draw every touched tile into the atlas. Returns the (n, 2) row and column of each, in atlas order."""
        maps = sorted(maps, key=lambda touched: touched.shadow.light)[:MAX_SHADOWS]
        ambient = ambient[:MAX_SHADOWS]
        plan = self._plan(views, maps, ambient, () if floor is None else floor.views)
        if not len(plan.tiles):
            return plan.tiles
        self._reserve(len(plan.tiles))
        self._additive = ground is not None and ground.additive
        self._floor = floor
        self._frame_uniforms = self._constants(maps, ambient, ground)
        self._prepared: set[Variant] = set()
        shadows.atlas.use(FIRST_UNIT + 1)
        shadows.ambient_atlas.use(FIRST_UNIT + 2)
        # all views first: reading a texture that has just been drawn makes a software renderer wait for it
        drawn = [draw_view(view) if batches else None for view, batches in zip(views, plan.batches, strict=False)]
        self._pictures = [] if floor is None else [floor.picture(view) for view in floor.views]
        assert self._framebuffer is not None
        self._context.gl.enable_only(moderngl.PROGRAM_POINT_SIZE)
        self._draw_coverage(plan, [view for view in drawn if view is not None])
        self._coverage.use(FIRST_UNIT + 3)
        self._framebuffer.use()
        self._last_drawn = next((view for view in drawn if view is not None), None)
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
            self._draw([(slots, mirrored, 0, 1) for slots in SLOTS for mirrored in range(-1, min(len(self._pictures), 1))], view)
        self._context.gl.enable_only(moderngl.NOTHING)

    def _plan(self, views: list[View], maps: list[Touched], ambient: list[Touched], mirrored: tuple[View, ...]) -> _Plan:
        """Which tiles are drawn with what; kept for as long as all masks are the same arrays."""
        masks = [view.tiles for view in (*views, *mirrored)] + [touched.tiles for touched in (*maps, *ambient)]
        sizes = (len(views), len(maps), len(mirrored))
        kept = self._last_plan
        if kept is not None and kept.sizes == sizes and len(kept.masks) == len(masks) and all(
                a is b for a, b in zip(kept.masks, masks, strict=True)):
            return kept
        plan = self._last_plan = _make_plan(views, maps, ambient, mirrored, masks, sizes)
        self._upload(plan.points)
        return plan

    def _upload(self, points: NDArray[np.int32]) -> None:
        if self._points.size < points.nbytes:
            release_all(*self._vertex_arrays.values(), self._coverage_array)
            self._vertex_arrays.clear()
            self._coverage_array = None
            self._points.orphan(2 * points.nbytes)
        self._points.write(points)

    def _reserve(self, count: int) -> None:
        rows = -(-count // ATLAS_COLUMNS)
        if rows > self._rows:
            self._release_target()
            self._rows = -(-rows // 8) * 8
            size = (ATLAS_COLUMNS * self._fragments, self._rows * self._fragments)
            dtypes = ["f1", "f1"] if self._is_yuv else ["f4"]
            self._textures = [self._context.texture(size, 4, dtype) for dtype in dtypes]
            self._framebuffer = self._context.gl.framebuffer(self._textures)

    def _variant(self, variant: Variant) -> tuple[moderngl.Program, moderngl.VertexArray]:
        if variant not in self._programs:
            view, maps, ambients, additive, floor = variant
            self._programs[variant] = self._context.program("composite.vert.glsl", "composite.frag.glsl", {
                **self._panorama.defines, "OUTPUT_YUV": int(self._is_yuv), "VIEW": view,
                "MAPS": maps, "AMBIENTS": ambients, "COVERAGE": 0, "ADDITIVE": int(additive),
                "FLOOR": int(floor)})
        program = self._programs[variant]
        if variant not in self._vertex_arrays:
            self._vertex_arrays[variant] = self._vertex_array(program)
        return program, self._vertex_arrays[variant]

    def _vertex_array(self, program: moderngl.Program) -> moderngl.VertexArray:
        names = [name for name, _ in POINT_LAYOUT if name in program]
        layout = " ".join(f"{count}i" if name in program else f"{4 * count}x" for name, count in POINT_LAYOUT)
        return self._context.gl.vertex_array(program, [(self._points, layout, *names)])

    def _constants(self, maps: list[Touched], ambient: list[Touched], ground: GroundLight | None) -> dict[str, object]:
        assert self._framebuffer is not None
        values: dict[str, object] = {
            "view_texture": FIRST_UNIT, "shadow_atlas": FIRST_UNIT + 1, "ambient_atlas": FIRST_UNIT + 2,
            "coverage": FIRST_UNIT + 3,
            "atlas_size": self._framebuffer.size, "tile_fragments": self._fragments, "tile_pixels": TILE,
            "atlas_columns": ATLAS_COLUMNS}
        if self._is_yuv:
            values["yuv_from_rgb"] = self._panorama.format.yuv_from_rgb().T
        if ground is None:
            return values
        rects = np.zeros((4, MAX_SHADOWS, 4))
        for kind, touched in ((0, maps), (2, ambient)):
            for index, item in enumerate(touched):
                rects[kind, index] = item.shadow.scaled_rect()
                rects[kind + 1, index] = (*item.shadow.cell_uv(), max(item.shadow.light, 0))
        lights = np.zeros((8, 3))
        lights[:len(ground.lights)] = np.reshape(ground.lights, (-1, 3))
        return values | {"ground_y": ground.y, "ground_irradiance": tuple(ground.total), "light_on_ground": lights,
                         "map_rect": rects[0], "map_cell": rects[1], "ambient_rect": rects[2], "ambient_cell": rects[3]}

    def _draw(self, batches: list[Batch], drawn: Drawn | None) -> None:
        kind = NO_VIEW if drawn is None else PERSPECTIVE if drawn.view.cube_axis < 0 else CUBE_FACE
        for (maps, ambients), mirrored, first, count in batches:
            variant = (kind, maps, ambients, self._additive, mirrored >= 0)
            program, vertex_array = self._variant(variant)
            self._panorama.bind(program)
            if variant not in self._prepared:
                self._prepared.add(variant)
                set_uniforms(program, self._frame_uniforms)
            if drawn is not None:
                _bind_view(program, drawn)
            if self._floor is not None and mirrored >= 0:
                _bind_floor(program, self._floor, mirrored, self._pictures[mirrored])
            vertex_array.render(moderngl.POINTS, vertices=count, first=first)

    def _draw_coverage(self, plan: _Plan, drawn: list[Drawn]) -> None:
        """What the views' objects cover, unless that is known."""
        views = [one.view for one in drawn]
        if len(views) == len(self._covered) and all(a is b for a, b in zip(views, self._covered, strict=True)):
            return
        self._covered = views
        rows = -(-plan.covered // ATLAS_COLUMNS)
        if rows * self._fragments > self._coverage.height:
            self._context.rest()
            release_all(self._coverage_target, self._coverage)
            self._make_coverage(-(-rows // 8) * 8)
        self._coverage_target.use()
        program = self._coverage_program
        set_uniforms(program, {"atlas_size": self._coverage.size})
        if self._coverage_array is None:
            self._coverage_array = self._vertex_array(program)
        for one, (first, count) in zip(drawn, plan.view_points, strict=True):
            one.silhouette.use(FIRST_UNIT + 3)
            set_uniforms(program, {"view_from_world": one.view.rotation.T, "silhouette": FIRST_UNIT + 3,
                                   "silhouette_from_tangent": one.silhouette_from_tangent.T})
            self._coverage_array.render(moderngl.POINTS, vertices=count, first=first)

    def _make_coverage(self, rows: int) -> None:
        size = (ATLAS_COLUMNS * self._fragments, rows * self._fragments)
        self._coverage = self._context.texture(size, 4 if self._is_yuv else 1, "f1", linear=False)
        self._coverage_target = self._context.gl.framebuffer([self._coverage])

    def _read(self, count: int, attachment: int) -> NDArray[np.generic]:
        """(count, fragments, fragments, 4) tiles of the atlas."""
        assert self._framebuffer is not None
        f = self._fragments
        rows = -(-count // ATLAS_COLUMNS)
        dtype = "f1" if self._is_yuv else "f4"
        data = self._framebuffer.read(viewport=(0, 0, ATLAS_COLUMNS * f, rows * f), components=4, attachment=attachment,
                                      alignment=1, dtype=dtype)
        pixels = np.frombuffer(data, "u1" if self._is_yuv else "f4").reshape(rows, f, ATLAS_COLUMNS, f, 4)
        return pixels.transpose(0, 2, 1, 3, 4).reshape(-1, f, f, 4)[:count]

    def write_yuv(self, frame: YuvFrame, tiles: NDArray[np.intp]) -> None:
        """Put the tiles into the planes, in place."""
        if not len(tiles):
            return
        half = TILE // 2
        luma = self._read(len(tiles), 0).reshape(-1, half, half, 2, 2).transpose(0, 1, 3, 2, 4).reshape(-1, TILE, TILE)
        chroma = self._read(len(tiles), 1)
        _scatter(frame.y, luma, tiles)
        _scatter(frame.u, chroma[..., 0], tiles)
        _scatter(frame.v, chroma[..., 1], tiles)

    def touched_radiance(self, tiles: NDArray[np.intp], frame: RgbFrame | RadianceFrame) -> tuple[NDArray[np.float32],
                                                                                                   NDArray[np.bool_]]:
        """(height, width, 3) composited radiance, zero where untouched, and the (height, width) mask of touched pixels."""
        height, width = frame.rgb.shape[:2]
        radiance = np.zeros((height, width, 4), dtype=np.float32)
        if len(tiles):
            _scatter(radiance, self._read(len(tiles), 0), tiles)
        return radiance[..., :3], radiance[..., 3] > 0.5

    def _release_target(self) -> None:
        self._context.rest()
        release_all(self._framebuffer, *self._textures)

    def release(self) -> None:
        self._release_target()
        release_all(*self._vertex_arrays.values(), *self._programs.values(), self._points)
        release_all(self._coverage_array, self._coverage_target, self._coverage, self._coverage_program)


def _bind_view(program: moderngl.Program, drawn: Drawn) -> None:
    view = drawn.view
    drawn.radiance.use(FIRST_UNIT)
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


def _make_plan(views: list[View], maps: list[Touched], ambient: list[Touched], mirrored: tuple[View, ...], masks: list[TileMask],
               sizes: tuple[int, int, int]) -> _Plan:
    tiles = np.argwhere(np.logical_or.reduce(masks)) if masks else np.zeros((0, 2), dtype=np.intp)
    map_lists, ambient_lists = _reached(tiles, maps, SLOTS[-1][0]), _reached(tiles, ambient, SLOTS[-1][1])
    rows = np.concatenate([tiles[:, ::-1], np.arange(len(tiles))[:, None], map_lists, ambient_lists,
                           np.full((len(tiles), 1), -1)], axis=1).astype("i4")
    kinds = _slots(map_lists, ambient_lists)
    mirrors = np.full(len(tiles), -1)
    for index, view in enumerate(mirrored):
        mirrors[view.tiles[tiles[:, 0], tiles[:, 1]]] = index
    in_views = [view.tiles[tiles[:, 0], tiles[:, 1]] for view in views]
    no_view = ~np.logical_or.reduce(in_views) if in_views else np.ones(len(tiles), dtype=bool)
    points: list[NDArray[np.int32]] = [np.zeros((0, POINT_INTS), dtype="i4")]
    batches: list[list[Batch]] = []
    view_points: list[tuple[int, int]] = []
    first = covered = 0
    for members in (*in_views, no_view):
        batches.append([])
        rows[members, -1] = covered + np.arange(members.sum())      # by tile alone: it stays as other shadows come and go
        if members is not no_view and members.any():
            view_points.append((first, int(members.sum())))
        for kind, mirror in np.unique(np.stack([kinds, mirrors], axis=1)[members], axis=0):
            points.append(rows[members & (kinds == kind) & (mirrors == mirror)])
            batches[-1].append((SLOTS[kind], int(mirror), first, len(points[-1])))
            first += len(points[-1])
        covered += int(members.sum()) if members is not no_view else 0
    return _Plan(tiles, np.concatenate(points), batches, view_points, covered, masks, sizes)


def _reached(tiles: NDArray[np.intp], touched: list[Touched], most: int) -> NDArray[np.intp]:
    """(tiles, most) indices of the shadow maps that reach each tile, in their order, then -1."""
    if not touched:
        return np.full((len(tiles), most), -1, dtype=np.intp)
    reached = np.stack([t.tiles[tiles[:, 0], tiles[:, 1]] for t in touched], axis=1)
    order = np.argsort(~reached, axis=1, kind="stable")[:, :most]
    lists = np.where(np.take_along_axis(reached, order, axis=1), order, -1)
    return np.pad(lists, ((0, 0), (0, most - lists.shape[1])), constant_values=-1)


def _slots(map_lists: NDArray[np.intp], ambient_lists: NDArray[np.intp]) -> NDArray[np.intp]:
    """The first of SLOTS that holds each row's entries."""
    maps, ambients = ((lists >= 0).sum(axis=1)[:, None] for lists in (map_lists, ambient_lists))
    most_maps, most_ambients = np.transpose(SLOTS)
    return np.asarray(np.argmax((maps <= most_maps) & (ambients <= most_ambients), axis=1))


def _scatter(plane: NDArray[np.generic], blocks: NDArray[np.generic], tiles: NDArray[np.intp]) -> None:
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

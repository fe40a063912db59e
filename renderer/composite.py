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
from renderer.panorama import PanoramaTextures, source_defines
from renderer.placement import TILE, TileMask, View
from renderer.shadows import ShadowMap, ShadowStage

Array = NDArray[np.float64]
MAX_MAPS = 16             # of each kind in one tile; as in composite.frag.glsl
ATLAS_COLUMNS = 16
FIRST_UNIT = 16           # after those of the object stage, which draws in between

DrawView = Callable[[View], tuple[moderngl.Texture, tuple[int, int]]]


@dataclass(frozen=True)
class GroundLight:
    """What the ground receives without objects: total, per light (by index), and the residual's (9, 3) coefficients."""

    y: float
    total: Array
    lights: list[Array]
    residual: Array


@dataclass(frozen=True)
class Touched:
    """Tiles of one shadow map."""

    shadow: ShadowMap
    tiles: TileMask


class CompositeStage:
    """Owns the composite program and its output atlas for one source geometry."""

    def __init__(self, context: Context, panorama: PanoramaTextures) -> None:
        self._context = context
        self._panorama = panorama
        self._is_yuv = panorama.kind is YuvFrame
        self._fragments = TILE // 2 if self._is_yuv else TILE
        defines = {**source_defines(panorama.kind), "OUTPUT_YUV": int(self._is_yuv)}
        self._program = context.program("composite.vert.glsl", "composite.frag.glsl", defines)
        self._rows = 0
        self._textures: list[moderngl.Texture] = []
        self._framebuffer: moderngl.Framebuffer | None = None
        self._instances = context.gl.buffer(reserve=12 * 64)
        self._vertex_array: moderngl.VertexArray | None = None

    def run(self, views: list[View], draw_view: DrawView, maps: list[Touched], ambient: list[Touched],
            ground: GroundLight | None, shadows: ShadowStage) -> NDArray[np.intp]:
        """Draw every touched tile into the atlas. Returns the (n, 2) row and column of each, in atlas order."""
        masks = [view.tiles for view in views] + [touched.tiles for touched in (*maps, *ambient)]
        if not masks:
            return np.zeros((0, 2), dtype=np.intp)
        tiles = np.argwhere(np.logical_or.reduce(masks))
        if not len(tiles):
            return tiles
        self._reserve(len(tiles))
        self._bind_constants(ground, shadows)
        map_groups = _group_tiles(tiles, maps, ambient)
        done = np.zeros(len(tiles), dtype=bool)
        for view in views:
            in_view = view.tiles[tiles[:, 0], tiles[:, 1]]
            if not in_view.any():
                continue
            texture, size = draw_view(view)
            self._bind_view(view, texture, size)
            for (map_ids, ambient_ids), members in map_groups.items():
                self._draw(tiles, members[in_view[members]], [maps[i] for i in map_ids], [ambient[i] for i in ambient_ids], ground)
            done |= in_view
        set_uniforms(self._program, {"has_view": 0, "view_axis": -1})
        for (map_ids, ambient_ids), members in map_groups.items():
            self._draw(tiles, members[~done[members]], [maps[i] for i in map_ids], [ambient[i] for i in ambient_ids], ground)
        return tiles

    def _reserve(self, count: int) -> None:
        rows = -(-count // ATLAS_COLUMNS)
        if rows > self._rows:
            self._release_target()
            self._rows = -(-rows // 8) * 8
            size = (ATLAS_COLUMNS * self._fragments, self._rows * self._fragments)
            dtypes = ["f1", "f1"] if self._is_yuv else ["f4"]
            self._textures = [self._context.texture(size, 4, dtype) for dtype in dtypes]
            self._framebuffer = self._context.gl.framebuffer(self._textures)
        if self._instances.size < 12 * count or self._vertex_array is None:
            if self._vertex_array is not None:
                self._vertex_array.release()
            self._instances.orphan(12 * max(64, 2 * count))
            self._vertex_array = self._context.gl.vertex_array(self._program, [(self._instances, "3i/i", "tile")])

    def _bind_constants(self, ground: GroundLight | None, shadows: ShadowStage) -> None:
        textures = [shadows.atlas, *shadows.transfer]
        for unit, (name, texture) in enumerate(zip(("shadow_atlas", "transfer_0", "transfer_1", "transfer_2"), textures,
                                                   strict=True), start=FIRST_UNIT + 1):
            texture.use(unit)
            set_uniforms(self._program, {name: unit})
        assert self._framebuffer is not None
        set_uniforms(self._program, {
            "atlas_size": self._framebuffer.size, "tile_fragments": self._fragments, "tile_pixels": TILE,
            "atlas_columns": ATLAS_COLUMNS, "view_texture": FIRST_UNIT,
            "yuv_from_rgb": self._panorama.format.yuv_from_rgb().T if self._is_yuv else 0,
            "has_view": 0, "view_axis": -1})
        if ground is not None:
            set_uniforms(self._program, {"ground_y": ground.y, "ground_irradiance": tuple(ground.total),
                                         "residual_sh": ground.residual})

    def _bind_view(self, view: View, texture: moderngl.Texture, size: tuple[int, int]) -> None:
        texture.use(FIRST_UNIT)
        left, right, bottom, top = view.bounds
        # the view fills only a part of its texture
        scale_x, scale_y = size[0] / texture.width, size[1] / texture.height
        set_uniforms(self._program, {
            "has_view": 1, "view_axis": view.cube_axis, "view_from_world": view.rotation.T,
            "view_bounds": (left, bottom, 1 / (right - left), 1 / (top - bottom)), "view_scale": (scale_x, scale_y)})

    def _draw(self, tiles: NDArray[np.intp], members: NDArray[np.intp], maps: list[Touched], ambient: list[Touched],
              ground: GroundLight | None) -> None:
        if not len(members):
            return
        assert self._vertex_array is not None
        assert self._framebuffer is not None
        by_light = sorted((touched.shadow for touched in maps), key=lambda shadow: shadow.light)[:MAX_MAPS]
        hidden = [touched.shadow for touched in ambient][:MAX_MAPS]
        values: dict[str, object] = {"map_count": len(by_light), "ambient_count": len(hidden)}
        if by_light and ground is not None:
            ends = [int(i + 1 == len(by_light) or by_light[i + 1].light != s.light) for i, s in enumerate(by_light)]
            values |= {"map_rect": _padded([s.scaled_rect() for s in by_light]),
                       "map_cell": _padded([s.cell_uv() for s in by_light]),
                       "map_irradiance": _padded([tuple(ground.lights[s.light]) for s in by_light]),
                       "map_ends_light": tuple(ends + [0] * (MAX_MAPS - len(ends)))}
        if hidden:
            values |= {"ambient_rect": _padded([s.scaled_rect() for s in hidden]),
                       "ambient_cell": _padded([s.cell_uv() for s in hidden])}
        set_uniforms(self._program, values)
        instances = np.stack([tiles[members, 1], tiles[members, 0], members], axis=1).astype("i4")
        self._instances.write(instances.tobytes())
        self._panorama.bind(self._program)
        self._framebuffer.use()
        self._vertex_array.render(moderngl.TRIANGLE_STRIP, vertices=4, instances=len(members))

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
        release_all(self._vertex_array, self._instances, self._program)


def _padded(rows: list[tuple[float, ...]]) -> NDArray[np.float64]:
    array = np.array(rows, dtype=np.float64)
    return np.pad(array, ((0, MAX_MAPS - len(array)), (0, 0)))


def _group_tiles(tiles: NDArray[np.intp], maps: list[Touched],
                 ambient: list[Touched]) -> dict[tuple[tuple[int, ...], tuple[int, ...]], NDArray[np.intp]]:
    """Tiles by the shadow maps that reach them, so that each pixel looks only those up."""
    def membership(touched: list[Touched]) -> NDArray[np.bool_]:
        if not touched:
            return np.zeros((len(tiles), 0), dtype=bool)
        return np.stack([t.tiles[tiles[:, 0], tiles[:, 1]] for t in touched], axis=1)

    in_maps, in_ambient = membership(maps), membership(ambient)
    groups: dict[tuple[tuple[int, ...], tuple[int, ...]], list[int]] = {}
    for index in range(len(tiles)):
        key = (tuple(np.flatnonzero(in_maps[index]).tolist()), tuple(np.flatnonzero(in_ambient[index]).tolist()))
        groups.setdefault(key, []).append(index)
    return {key: np.array(members, dtype=np.intp) for key, members in groups.items()}


def _scatter(plane: NDArray[np.generic], blocks: NDArray[np.generic], tiles: NDArray[np.intp]) -> None:
    """Write (n, size, size, ...) blocks to their tiles of a plane; tiles at the far edges are cut."""
    size = blocks.shape[1]
    rows, columns = plane.shape[0] // size, plane.shape[1] // size
    whole = (tiles[:, 0] < rows) & (tiles[:, 1] < columns)
    grid = plane[:rows * size, :columns * size].reshape(rows, size, columns, size, *plane.shape[2:]).swapaxes(1, 2) \
        if plane[:rows * size, :columns * size].flags.c_contiguous else None
    if grid is not None:
        grid[tiles[whole, 0], tiles[whole, 1]] = blocks[whole]
    rest = np.flatnonzero(~whole) if grid is not None else np.arange(len(tiles))
    for index in rest:
        row, column = tiles[index] * size
        target = plane[row:row + size, column:column + size]
        target[...] = blocks[index][:target.shape[0], :target.shape[1]]

"""What share of each pixel objects cover: drawn once per move, tile by tile, into an atlas of its own."""

from __future__ import annotations

import moderngl

from renderer.compositing.tile_plan import ATLAS_COLUMNS, POINT_INTS, POINT_LAYOUT, coverage_points
from renderer.gl import Context, release_all, set_uniforms
from renderer.objects.placement import TILE, View
from renderer.objects.shading import Drawn

PERSPECTIVE = 1     # as in composite.frag.glsl


def points_array(context: Context, program: moderngl.Program, points: moderngl.Buffer) -> moderngl.VertexArray:
    """Points of POINT_LAYOUT for a program that takes some of them."""
    names = [name for name, _ in POINT_LAYOUT if name in program]
    layout = " ".join(f"{count}i" if name in program else f"{4 * count}x" for name, count in POINT_LAYOUT)
    return context.gl.vertex_array(program, [(points, layout, *names)])


class CoverageStage:
    """Owns the atlas of one source geometry. `in_fours`: a texel holds four pixels. `unit`: a texture unit that is free for it."""

    def __init__(self, context: Context, frame_size: tuple[int, int], unit: int, *, in_fours: bool) -> None:
        self._context, self._unit, self._in_fours = context, unit, in_fours
        self._side = TILE // 2 if in_fours else TILE    # texels of a tile
        self._program = context.program("composite.vert.glsl", "coverage.frag.glsl", {
            "OUTPUT_YUV": int(in_fours), "VIEW": PERSPECTIVE, "MAPS": 0, "AMBIENTS": 0, "COVERAGE": 1})
        set_uniforms(self._program, {"frame_size": frame_size, "tile_fragments": self._side, "tile_pixels": TILE,
                                     "atlas_columns": ATLAS_COLUMNS})
        self._points = context.gl.buffer(reserve=4 * POINT_INTS * 256)
        self._array = points_array(context, self._program, self._points)
        self._covered: list[View] = []      # the views that are in the atlas
        self._make(8)

    def use(self, drawn: list[Drawn]) -> None:
        """Have what the views' objects cover in the atlas, and the atlas in its unit."""
        views = [one.view for one in drawn]
        if len(views) != len(self._covered) or any(a is not b for a, b in zip(views, self._covered, strict=True)):
            self._covered = views
            self._draw(drawn)
        self._atlas.use(self._unit)

    def _draw(self, drawn: list[Drawn]) -> None:
        points = coverage_points(self._covered)
        rows = -(-len(points) // ATLAS_COLUMNS)
        if rows * self._side > self._atlas.height:
            self._context.rest()
            release_all(self._target, self._atlas)
            self._make(-(-rows // 8) * 8)
        if self._points.size < points.nbytes:
            self._array.release()
            self._points.orphan(2 * points.nbytes)
            self._array = points_array(self._context, self._program, self._points)
        self._points.write(points)
        self._target.use()
        set_uniforms(self._program, {"atlas_size": self._atlas.size})
        first = 0
        for one in drawn:
            one.silhouette.use(self._unit)
            set_uniforms(self._program, {"view_from_world": one.view.rotation.T, "silhouette": self._unit,
                                         "silhouette_from_tangent": one.silhouette_from_tangent.T})
            count = int(one.view.tiles.sum())
            self._array.render(moderngl.POINTS, vertices=count, first=first)
            first += count

    def _make(self, rows: int) -> None:
        self._atlas = self._context.texture((ATLAS_COLUMNS * self._side, rows * self._side), 4 if self._in_fours else 1, "f1",
                                            linear=False)
        self._target = self._context.gl.framebuffer([self._atlas])

    def release(self) -> None:
        self._context.rest()
        release_all(self._array, self._points, self._target, self._atlas, self._program)

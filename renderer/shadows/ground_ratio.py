"""The ground's shadows as one picture of the ground, for reflections of it: how much light each place still has."""

from __future__ import annotations

from collections.abc import Sequence

import moderngl
import numpy as np
from numpy.typing import NDArray

from renderer.gl import Context, release_all, set_uniforms
from renderer.shadows.shadow_atlas import ShadowAtlases, ShadowMap

Array = NDArray[np.floating]
SIZE = 128                 # texels a side
MAX_MAPS = 64              # as in ground_ratio.vert.glsl
LEVELS = 5
PATIENCE = 4               # frames that it may be late: nobody sees a reflected shadow lag
TOLERANCE = 0.02           # of a light's share: from here on the picture is drawn anew
FIRST_UNIT = 8


class GroundRatioStage:
    """Owns the picture: (SIZE, SIZE) share of the irradiance that is missing, with mip levels."""

    def __init__(self, context: Context) -> None:
        self._context = context
        self._program = context.program("ground_ratio.vert.glsl", "ground_ratio.frag.glsl")
        self._quad = context.gl.vertex_array(self._program, [])
        self.texture = context.texture((SIZE, SIZE), 4, "f2")
        self.texture.build_mipmaps(0, LEVELS)
        self.texture.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)
        self._framebuffer = context.gl.framebuffer([self.texture])
        self._waited = 0
        self._drawn: tuple[list[ShadowMap], list[ShadowMap], Array] | None = None
        self.rect = (0.0, 0.0, 1.0, 1.0)        # x0, z0, 1 / width, 1 / depth in metres

    def draw(self, maps: list[ShadowMap], ambient: list[ShadowMap], lights: Sequence[Array], total: Array,
             atlases: ShadowAtlases) -> None:
        """`lights` and `total` are irradiances of the open ground; map indices refer to `lights`."""
        shares = np.array([*lights, total]) / np.maximum(total, 1e-6)
        self._waited += 1
        drawn = self._drawn
        if drawn is not None and drawn[2].shape == shares.shape and (self._waited < PATIENCE or (
                drawn[:2] == (maps, ambient) and np.abs(drawn[2] - shares).max() < TOLERANCE)):
            return
        self._waited, self._drawn = 0, (maps, ambient, shares)
        self._framebuffer.use()
        self._framebuffer.clear()
        rects = np.array([shadow.rect for shadow in (*maps, *ambient)])
        if len(rects):
            low, high = rects[:, :2].min(axis=0), rects[:, 2:].max(axis=0)
            self.rect = (float(low[0]), float(low[1]), float(1 / (high[0] - low[0])), float(1 / (high[1] - low[1])))
            self._context.gl.enable_only(moderngl.BLEND)
            self._context.gl.blend_func = moderngl.ONE, moderngl.ONE
            inverse = 1 / np.maximum(total, 1e-6)
            self._add(maps, atlases.lights, [lights[shadow.light] * inverse for shadow in maps], is_share=True)
            self._add(ambient, atlases.ambient, [inverse for _ in ambient], is_share=False)
            self._context.gl.enable_only(moderngl.NOTHING)
        self.texture.build_mipmaps(0, LEVELS)

    def _add(self, maps: list[ShadowMap], atlas: moderngl.Texture, weights: list[Array], *, is_share: bool) -> None:
        count = min(len(maps), MAX_MAPS)
        if count == 0:
            return
        rect, cell, weight = np.zeros((MAX_MAPS, 4)), np.zeros((MAX_MAPS, 3)), np.zeros((MAX_MAPS, 3))
        for index in range(count):
            rect[index], cell[index], weight[index] = maps[index].rect, maps[index].cell, weights[index]
        atlas.use(FIRST_UNIT)
        set_uniforms(self._program, {"atlas": FIRST_UNIT, "is_share": int(is_share), "ground_rect": self.rect, "map_rect": rect,
                                     "map_cell": cell, "map_weight": weight})
        self._quad.render(moderngl.TRIANGLE_STRIP, vertices=4, instances=count)

    def reset(self) -> None:
        """The next light has nothing to do with the last one: draw at once."""
        self._drawn = None

    def release(self) -> None:
        self._context.rest()
        release_all(self._framebuffer, self.texture, self._quad, self._program)

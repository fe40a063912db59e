"""What objects take from the ground of the light around: the residual's occlusion as transfer vectors (Sloan 2002).

What an object hides depends on geometry alone, so it is kept until the object moves. With the light it becomes missing irradiance,
less what the object gives back, for all objects that are near each other in one map, so that the composite looks up one.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import moderngl
import numpy as np
from numpy.typing import NDArray

from renderer.gl import Context, release_all, set_uniforms
from renderer.models.gpu_mesh import PlacedMesh
from renderer.objects.placement import TileMask, touched_tiles
from renderer.shadows.shadow_atlas import GRID, Blocks, Place, Rect, ShadowMap, outline, sharing, union
from renderer.shadows.shadow_casters import CasterMesh, RealThings

Array = NDArray[np.float64]
CELL = 64                  # texels a side of one object's transfer
MAX_CELLS = 4              # as many a side of what objects take together
MISSING_GRID = 16          # blocks a side of that atlas
SAMPLES = 96
REACH = 1.5                # in heights of an object: what it hides from there is a few hundredths
VISIBLE = 0.006            # of the ground's light, two thirds of a code of 8 bits at white
UNEVEN = 2.0               # how much brighter than the mean what is hidden may be
SHARES = (0.1, 0.2, 0.35, 0.6, 1.0)     # that are told apart
FIRST_UNIT = 8             # texture units after the panorama's


@dataclass
class _Kept:
    """An object's transfer."""

    place: Place
    state: bytes
    rect: Rect
    cell: tuple[float, float, float]
    bounds: tuple[Array, Array]     # of the object: low and high corner, from the ground up
    tiles: dict[float, TileMask]    # that show where it is seen, by the extent of that


@dataclass(frozen=True)
class _Taken:
    """What objects take together."""

    place: Place
    standing: bytes         # where they stand, and how far it is seen of each
    state: bytes
    shadow: ShadowMap


class AmbientShadowStage:
    """Owns the transfer of every object and the atlas of what is missing."""

    def __init__(self, context: Context, frame_size: tuple[int, int]) -> None:
        self._context, self._frame_size = context, frame_size
        gl = context.gl
        self._program = context.program("shadow.vert.glsl", "ambient_shadow.frag.glsl")
        self._casters = CasterMesh(context, self._program)
        size = (GRID * CELL,) * 2
        self._transfer = [context.texture(size, 4, "f2") for _ in range(3)]
        self._depth = gl.depth_renderbuffer(size)
        self._target = gl.framebuffer(self._transfer, self._depth)
        self.atlas = context.texture((MISSING_GRID * CELL,) * 2, 4, "f2")
        self._missing_program = context.program("ambient_missing.vert.glsl", "ambient_missing.frag.glsl")
        self._missing_quad = gl.vertex_array(self._missing_program, [])
        self._missing_target = gl.framebuffer([self.atlas])
        self._cells, self._blocks = Blocks(GRID * CELL), Blocks(MISSING_GRID * CELL, MISSING_GRID)
        self._kept: dict[str, _Kept] = {}
        self._maps: dict[tuple[str, ...], _Taken] = {}
        index = np.arange(SAMPLES)
        radius, phi = np.sqrt((index + 0.5) / SAMPLES), index * np.pi * (3 - np.sqrt(5))
        # by cosine: each stands for pi / SAMPLES of irradiance
        self._upper = np.stack([radius * np.cos(phi), np.sqrt(1 - radius**2), radius * np.sin(phi)], axis=1)

    def run(self, casters: dict[str, PlacedMesh], hidden: dict[str, Array], ground_y: float, real: RealThings,
            ambient_share: float = 1.0) -> list[ShadowMap]:
        """`hidden`: of each caster (9, 3) coefficients of the radiance that it hides in this frame, less what it gives back itself;
        what is missing may be negative. `ambient_share`: of the ground's light, the less the nearer is what is seen."""
        self._free_cells(name for name in list(self._kept) if name not in casters)
        for name, placed in casters.items():
            self._keep(name, placed, ground_y, real.hiding(None))
        share = next(level for level in SHARES if level >= min(ambient_share, 1.0))
        seen = {name: self._seen(self._kept[name], ground_y, share) for name in casters if name in self._kept}
        groups = sharing({name: tiles for name, (_, tiles) in seen.items()})
        for names in [names for names in self._maps if names not in groups]:
            self._blocks.give_back(self._maps.pop(names).place)
        return [shadow for names in groups if (shadow := self._weighed(names, hidden, seen)) is not None]

    def _seen(self, kept: _Kept, ground_y: float, share: float) -> tuple[float, TileMask]:
        """How much of its part of the ground an object visibly darkens, as a factor of its sides, and the tiles that show it."""
        x0, z0, x1, z1 = kept.rect
        extent = min(visible_reach(*kept.bounds, share) / (min(x1 - x0, z1 - z0) / 2), 1.0)
        if extent not in kept.tiles:
            x, z, half_x, half_z = (x0 + x1) / 2, (z0 + z1) / 2, extent * (x1 - x0) / 2, extent * (z1 - z0) / 2
            edge = outline((x - half_x, z - half_z, x + half_x, z + half_z), ground_y, is_round=True)
            kept.tiles[extent] = touched_tiles(edge, self._frame_size)
        return extent, kept.tiles[extent]

    def _keep(self, name: str, placed: PlacedMesh, ground_y: float, real: list[PlacedMesh]) -> None:
        """Draw an object's transfer unless it holds."""
        state = b"".join(item.state() for item in (placed, *real)) + np.float64(ground_y).tobytes()
        kept = self._kept.get(name)
        if kept is not None and kept.state == state:
            return
        self._free_cells([name] if kept is not None else [])
        points = placed.outline()
        low, high = points.min(axis=0), points.max(axis=0)
        place = self._cells.take(CELL) if high[1] > ground_y else None
        if place is None:
            return
        reach = REACH * max(high[1] - ground_y, 0.3 * float(np.linalg.norm(high - low)))
        rect = (float(low[0] - reach), float(low[2] - reach), float(high[0] + reach), float(high[2] + reach))
        bounds = np.maximum(low - [0, ground_y, 0], [-np.inf, 0, -np.inf]), high - [0, ground_y, 0]
        self._kept[name] = _Kept(place, state, rect, self._cells.cell(place, CELL), bounds, {})
        self._target.use()
        self._target.viewport = self._cells.viewport(place)
        self._target.clear(0.0, 0.0, 0.0, 0.0, depth=1.0, viewport=self._cells.viewport(place))
        self._casters.draw([placed], real, fine=False, ground=(rect, ground_y), samples=(self._upper, np.pi / SAMPLES))

    def _free_cells(self, names: Iterable[str]) -> None:
        for name in names:
            self._cells.give_back(self._kept.pop(name).place)

    def _weighed(self, names: tuple[str, ...], hidden: dict[str, Array],
                 seen: dict[str, tuple[float, TileMask]]) -> ShadowMap | None:
        """The map of what these take together."""
        members = [self._kept[name] for name in names]
        standing = b"".join(self._kept[name].state + np.float64(seen[name][0]).tobytes() for name in names)
        state = standing + b"".join(hidden[name].tobytes() for name in names)
        before = self._maps.get(names)
        if before is not None and before.state == state:
            return before.shadow
        # the same array for as long as nothing moves: the composite's plan is kept with it
        tiles = (before.shadow.tiles if before is not None and before.standing == standing
                 else np.logical_or.reduce([seen[name][1] for name in names]))
        rect = union([one.rect for one in members])
        # as fine as the finest of them
        finer = max((rect[i + 2] - rect[i]) / (one.rect[i + 2] - one.rect[i]) for one in members for i in (0, 1))
        texels = int(np.clip(np.ceil(finer * CELL), CELL, MAX_CELLS * CELL))
        if before is not None:
            self._blocks.give_back(self._maps.pop(names).place)
        place = self._blocks.take(texels)
        if place is None:
            return None
        texels = min(texels, place.blocks * CELL)
        shadow = ShadowMap(self._blocks.cell(place, texels), rect, tiles)
        self._maps[names] = _Taken(place, standing, state, shadow)
        self._weigh(shadow, self._blocks.viewport(place), texels,
                    [(self._kept[name], hidden[name], seen[name][0]) for name in names])
        return shadow

    def _weigh(self, shadow: ShadowMap, viewport: tuple[int, int, int, int], texels: int,
               members: list[tuple[_Kept, Array, float]]) -> None:
        self._missing_target.use()
        self._missing_target.clear(0.0, 0.0, 0.0, 0.0, viewport=viewport)
        self._missing_target.viewport = (*viewport[:2], texels, texels)
        gl = self._context.gl
        gl.enable_only(moderngl.BLEND)
        gl.blend_func = moderngl.ONE, moderngl.ONE
        for unit, texture in enumerate(self._transfer):
            texture.use(FIRST_UNIT + unit)
            set_uniforms(self._missing_program, {f"transfer_{unit}": FIRST_UNIT + unit})
        for kept, coefficients, extent in members:
            set_uniforms(self._missing_program, {"map_rect": shadow.scaled_rect(), "rect": kept.rect, "cell": kept.cell,
                                                 "hidden_sh": coefficients, "extent": extent})
            self._missing_quad.render(moderngl.TRIANGLE_STRIP, vertices=4)
        gl.enable_only(moderngl.NOTHING)

    def release(self) -> None:
        self._context.rest()
        release_all(self._casters, self._target, *self._transfer, self._depth, self._program, self._missing_target,
                    self._missing_quad, self._missing_program, self.atlas)


def visible_reach(low: Array, high: Array, share: float) -> float:
    """How far in metres from its middle an object visibly darkens the ground, where `share` of the light is ambient. `low`, `high`:
    (3,) corners of a box around it, heights from the ground up.

    From far off it is an upright rectangle, w to either side and from b to h high. At the distance d it takes w / (pi d)
    (h^2 / (h^2 + d^2) - b^2 / (b^2 + d^2)) of the cosine-weighted view.
    """
    width, base, height = float(np.hypot(*(high - low)[[0, 2]])) / 2, float(low[1]), float(high[1])
    distance = np.linspace(width, width + REACH * max(height, width), 64)
    taken = width / (np.pi * distance) * (height**2 / (height**2 + distance**2) - base**2 / (base**2 + distance**2))
    visible = UNEVEN * share * taken > VISIBLE
    return float(distance[np.flatnonzero(visible)[-1]]) if visible.any() else float(distance[0])

"""Shadows of lights on the ground plane: an area light as many projected hard shadows.

No shadow map in the usual sense: proxies are projected onto the plane along each sample direction of a light and counted
(Heckbert & Herf 1997), so there is no bias to tune, contact is exact and the penumbra follows from the light's size. Objects whose
shadows may overlap share a map: what two of them hide is hidden once.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from renderer.equirectangular import uv_from_direction
from renderer.gl import Context, release_all
from renderer.light.detection import Light
from renderer.light.discs import STALE_SHARE, disc_directions, hardly_moved
from renderer.models.gpu_mesh import PlacedMesh
from renderer.objects.placement import TileMask, touched_tiles
from renderer.objects.surfaces import SurfaceStage
from renderer.quality import FULL
from renderer.shadows.shadow_atlas import GRID, Blocks, Place, Rect, ShadowMap, outline, sharing, union
from renderer.shadows.shadow_casters import CasterMesh, RealThings, proxy
from renderer.shadows.shadow_mapping import ShadowMapping, filter_reach

Array = NDArray[np.float64]
CELL = 256                 # texels a side of one object's shadow map, at most; of more objects by the root of their number
MIN_SAMPLES, MAX_SAMPLES = 6, 32    # of a light's disc
MAX_MOVING_SAMPLES = 10    # the same, and texels a side, of a shadow that has just moved
MOVING_TEXELS = 128
SETTLED_FRAMES = 8         # that a shadow holds before it is drawn finely again
MAX_TRIANGLES = 20_000     # of all samples together, for finer proxies: coarse ones show their corners
MAX_MOVING_TRIANGLES = 6000
SLACK = np.radians(1.0)    # that a light may move while the tiles that show a shadow are kept
SHARP = 4                  # texels; a wider penumbra that has just moved does not show them
MIN_ELEVATION = np.sin(np.radians(3.0))   # of a sample; flatter ones would cast without end
MAX_REACH_M = 40.0
_PADDING = 0.02     # of a rectangle, so that no shadow touches its edge


_Drawn = tuple[Place, tuple[float, float, float], Rect]     # its cell in the atlas, what of the ground it shows


@dataclass
class _Kept:
    place: Place
    state: bytes
    light: Light
    shadow: ShadowMap
    is_fine: bool
    detail: float
    frames: int = 0     # that it has held


class LightShadowStage:
    """Owns the program and the atlas of the lights' shadows."""

    def __init__(self, context: Context, frame_size: tuple[int, int], surfaces: SurfaceStage) -> None:
        self._context, self._surfaces, self._frame_size = context, surfaces, frame_size
        self._program = context.program("shadow.vert.glsl", "shadow.frag.glsl")
        self._casters = CasterMesh(context, self._program)
        self._mapping: ShadowMapping | None = None      # made when it is first wanted
        size = (GRID * CELL,) * 2
        self.atlas = context.texture(size, 1, "f2")
        self._depth = context.gl.depth_renderbuffer(size)
        self._target = context.gl.framebuffer([self.atlas], self._depth)
        self._blocks = Blocks(GRID * CELL)
        self._tiles: dict[tuple[int, str], tuple[bytes, Light, TileMask | None]] = {}
        self._kept: dict[tuple[int, tuple[str, ...]], _Kept] = {}
        self._real = RealThings()
        self._redrawn = 0
        self.quality = FULL

    def begin(self, keys: set[str], lights: set[int], real: RealThings) -> None:
        """Begin a frame. Forget all objects and lights but those of `keys` and `lights` (ids)."""
        self._real, self._redrawn = real, 0
        self._tiles = {name: kept for name, kept in self._tiles.items() if name[0] in lights and name[1] in keys}
        self._drop(name for name in self._kept if name[0] not in lights or not keys.issuperset(name[1]))

    def run(self, casters: dict[str, PlacedMesh], light: Light, light_index: int, ground_y: float, *,
            filtered: bool = False) -> list[ShadowMap]:
        """The shadows of one light, drawn unless the last ones still hold. `filtered`: by the papers' method, `shadow_mapping.py`.

        One holds while objects and ground are as they were and the light has moved by less than a quarter of its radius: the
        shadow's edge then errs by less than an eighth of its penumbra. Up to a whole radius it waits for its turn, one map a
        frame, so that a moving sun does not have all shadows drawn in the same frame. What is drawn anew is drawn coarser than at
        first, and finely again when nothing has moved for a while.
        """
        tiles = {key: self._tiles_of(key, placed, light, ground_y, filtered) for key, placed in casters.items()}
        groups = sharing({key: mask for key, mask in tiles.items() if mask is not None})
        before = {key for name in self._kept if name[0] == light.id for key in name[1]}
        self._drop(name for name in self._kept if name[0] == light.id and name[1] not in groups)
        found = []
        for names in groups:
            members = {key: casters[key] for key in names}
            shadow = self._held((light.id, names), members, light, ground_y, filtered, is_new=before.isdisjoint(names))
            if shadow is not None:
                found.append(replace(shadow, light=light_index))
        return found

    def _held(self, name: tuple[int, tuple[str, ...]], members: dict[str, PlacedMesh], light: Light, ground_y: float,
              filtered: bool, *, is_new: bool) -> ShadowMap | None:
        state = _state([*members.values(), *self._real.hiding(light)], ground_y) + bytes([filtered])
        kept = self._kept.get(name)
        if kept is not None and kept.state == state:
            if hardly_moved(kept.light, light, STALE_SHARE if self._redrawn == 0 else 1.0):
                kept.frames += 1
                is_best = kept.is_fine and kept.detail >= self.quality.shadow_detail
                if is_best or kept.frames < SETTLED_FRAMES or self._redrawn > 0:
                    return kept.shadow
            self._redrawn += 1
        is_fine = is_new if kept is None else kept.state == state and kept.frames >= SETTLED_FRAMES
        self._drop([name])
        drawn = (self._draw_filtered if filtered else self._draw)(list(members.values()), light, ground_y, is_fine)
        if drawn is None:
            return None
        place, cell, rect = drawn
        masks = [mask for key, placed in members.items()
                 if (mask := self._tiles_of(key, placed, light, ground_y, filtered)) is not None]
        shadow = ShadowMap(cell, rect, np.logical_or.reduce(masks))
        self._kept[name] = _Kept(place, state, light, shadow, is_fine or filtered, self.quality.shadow_detail)
        return shadow

    def _drop(self, names: Iterable[tuple[int, tuple[str, ...]]]) -> None:
        for name in list(names):
            kept = self._kept.pop(name, None)
            if kept is not None:
                self._blocks.give_back(kept.place)

    def _tiles_of(self, key: str, placed: PlacedMesh, light: Light, ground_y: float, filtered: bool) -> TileMask | None:
        """The tiles that show what of the ground an object's shadow may cover, None for nothing; kept for as long as it holds."""
        state = _state([placed], ground_y) + bytes([filtered])
        kept = self._tiles.get((light.id, key))
        if kept is None or kept[0] != state or not hardly_moved(kept[1], light, least=SLACK):
            rect = _covered(placed, replace(light, angular_radius=light.angular_radius + SLACK), ground_y, filtered)
            kept = (state, light, None if rect is None else touched_tiles(outline(rect, ground_y), self._frame_size))
            self._tiles[light.id, key] = kept
        return kept[2]

    def _draw(self, members: list[PlacedMesh], light: Light, ground_y: float, is_fine: bool) -> _Drawn | None:
        rects = [rect for item in members if (rect := _covered(item, light, ground_y, False)) is not None]
        if not rects:
            return None
        rect = union(rects)
        detail = self.quality.shadow_detail
        reserved = self._reserve(rect, ground_y, int(detail * np.sqrt(len(members)) * (CELL if is_fine else MOVING_TEXELS)))
        if reserved is None:
            return None
        place, texels = reserved
        texel = max(rect[2] - rect[0], rect[3] - rect[1]) / texels
        height = max(float(item.outline()[:, 1].max()) for item in members) - ground_y
        penumbra = 2 * light.angular_radius * height / max(float(light.direction[1]), 0.05)**2
        most = max(MIN_SAMPLES, detail * (MAX_SAMPLES if is_fine else MAX_MOVING_SAMPLES))
        wanted = int(np.clip(2 * penumbra / texel, MIN_SAMPLES, most))
        count = 1 if penumbra < 2 * texel else wanted
        samples = disc_directions(light.direction, light.angular_radius, count) if count > 1 else light.direction[None]
        samples = samples[samples[:, 1] > MIN_ELEVATION]
        if not len(samples):
            self._blocks.give_back(place)
            return None
        triangles = len(samples) * sum(len(proxy(item, fine=True)[1]) for item in members)
        fine = triangles <= MAX_TRIANGLES if is_fine else triangles <= MAX_MOVING_TRIANGLES and penumbra < SHARP * texel
        self._clear(place, texels)
        self._casters.draw(members, self._real.hiding(light), fine=fine,
                           ground=(rect, ground_y), samples=(samples, 1.0 / count))
        return place, self._blocks.cell(place, texels), rect

    def _draw_filtered(self, members: list[PlacedMesh], light: Light, ground_y: float,
                       _is_fine: bool) -> _Drawn | None:
        rects = [rect for item in members if (rect := _covered(item, light, ground_y, True)) is not None]
        if not rects:
            return None
        rect = union(rects)
        reserved = self._reserve(rect, ground_y, int(np.sqrt(len(members)) * CELL))
        if reserved is None:
            return None
        place, texels = reserved
        if self._mapping is None:
            self._mapping = ShadowMapping(self._context, self._surfaces)
        self._clear(place, texels)
        for item in members:
            self._mapping.fill(self._target, self._blocks.viewport(place, texels), rect, ground_y, item, item.outline(), light)
        return place, self._blocks.cell(place, texels), rect

    def _reserve(self, rect: Rect, ground_y: float, most: int) -> tuple[Place, int] | None:
        """A place, and texels a side that are about as fine as the frame's pixels that show the rectangle."""
        uv = uv_from_direction(outline(rect, ground_y))
        across = (uv[:, 0] - uv[0, 0] + 0.5) % 1.0
        pixels = max(np.ptp(across) * self._frame_size[0], np.ptp(uv[:, 1]) * self._frame_size[1])
        texels = int(np.clip(np.ceil(pixels / 16) * 16, 48, most))
        place = self._blocks.take(texels)
        return None if place is None else (place, min(texels, place.blocks * CELL))

    def _clear(self, place: Place, texels: int) -> None:
        self._target.use()
        self._target.clear(0.0, 0.0, 0.0, 0.0, depth=1.0, viewport=self._blocks.viewport(place))
        self._target.viewport = self._blocks.viewport(place, texels)

    def reset(self) -> None:
        """Forget the lights: the next ones have nothing to do with them."""
        self._drop(list(self._kept))
        self._tiles.clear()

    def release(self) -> None:
        self._context.rest()
        release_all(self._casters, self._target, self.atlas, self._depth, self._program, self._mapping)


def _state(placed: list[PlacedMesh], ground_y: float) -> bytes:
    return b"".join(item.state() for item in placed) + np.float64(ground_y).tobytes()


def _covered(placed: PlacedMesh, light: Light, ground_y: float, filtered: bool) -> Rect | None:
    """What of the ground an object's shadow may cover."""
    points = placed.outline()
    above = points[points[:, 1] > ground_y]
    if filtered:
        rim = light.direction[None]
    else:
        rim = np.concatenate([light.direction[None], disc_directions(light.direction, light.angular_radius, 12)])
    rim = rim[rim[:, 1] > MIN_ELEVATION]
    if not len(above) or not len(rim):
        return None
    heights = (above[:, 1] - ground_y)[:, None]
    x, z = (above[:, axis, None] - heights * (rim[:, axis] / rim[:, 1])[None, :] for axis in (0, 2))
    reach = filter_reach(points, light) if filtered else (0.0, 0.0)
    centre = above.mean(axis=0)[[0, 2]]
    low = [max(float(v.min()), float(c) - MAX_REACH_M) - more for v, c, more in zip((x, z), centre, reach, strict=True)]
    high = [min(float(v.max()), float(c) + MAX_REACH_M) + more for v, c, more in zip((x, z), centre, reach, strict=True)]
    pad = [max((b - a) * _PADDING, 1e-3) for a, b in zip(low, high, strict=True)]
    return (low[0] - pad[0], low[1] - pad[1], high[0] + pad[0], high[1] + pad[1])

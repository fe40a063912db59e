"""Maps of the ground's shadows: what they cover, which objects share one, and where they lie in an atlas."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import moderngl
import numpy as np
from numpy.typing import NDArray

from renderer.objects.placement import TileMask

Array = NDArray[np.float64]
Rect = tuple[float, float, float, float]    # x0, z0, x1, z1 in metres
GRID = 8                   # blocks a side of an atlas
MAX_GROUP = 12             # objects that share a map: when one moves all are drawn anew


class ShadowAtlases(NamedTuple):
    """The share of a light that is hidden, in red; the irradiance of the residual that is missing."""

    lights: moderngl.Texture
    ambient: moderngl.Texture


@dataclass(frozen=True)
class ShadowMap:
    """Where it lies in the atlas (u0, v0, size), what of the ground it shows, the tiles of the frame that show what is not empty in
    it, and the index of its light (-1: the residual)."""

    cell: tuple[float, float, float]
    rect: Rect
    tiles: TileMask = field(compare=False)
    light: int = -1

    def scaled_rect(self) -> tuple[float, float, float, float]:
        """x0, z0, 1 / width, 1 / depth."""
        x0, z0, x1, z1 = self.rect
        return (x0, z0, 1 / (x1 - x0), 1 / (z1 - z0))


def outline(rect: Rect, ground_y: float, *, is_round: bool = False) -> Array:
    """(n, 3) points on the edge of a rectangle of the ground, or of the ellipse in it."""
    x0, z0, x1, z1 = rect
    if is_round:
        angle = np.linspace(0, 2 * np.pi, 65)
        x, z = (x0 + x1) / 2 + (x1 - x0) / 2 * np.cos(angle), (z0 + z1) / 2 + (z1 - z0) / 2 * np.sin(angle)
        return np.stack([x, np.full_like(x, ground_y), z], axis=1)
    t = np.linspace(0, 1, 17)
    x = np.concatenate([x0 + (x1 - x0) * t, x0 + (x1 - x0) * t, np.full(17, x0), np.full(17, x1)])
    z = np.concatenate([np.full(17, z0), np.full(17, z1), z0 + (z1 - z0) * t, z0 + (z1 - z0) * t])
    return np.stack([x, np.full_like(x, ground_y), z], axis=1)


def union(rects: list[Rect]) -> Rect:
    """The rectangle around some."""
    x0, z0, x1, z1 = np.transpose(rects)
    return (float(x0.min()), float(z0.min()), float(x1.max()), float(z1.max()))


def sharing(tiles: dict[str, TileMask], most: int = MAX_GROUP) -> list[tuple[str, ...]]:
    """Groups of at most `most` that share tiles, so that a tile shows few of them."""
    groups: list[tuple[list[str], TileMask]] = []
    for name, mask in tiles.items():
        members, merged, separate = [name], mask, []
        for names, other in groups:
            if len(members) + len(names) <= most and (merged & other).any():
                members, merged = names + members, merged | other
            else:
                separate.append((names, other))
        groups = [*separate, (members, merged)]
    return [tuple(names) for names, _ in groups]


class Place(NamedTuple):
    """A square of blocks of an atlas."""

    column: int
    row: int
    blocks: int


class Blocks:
    """Which blocks of an atlas of `texels` a side are in use."""

    def __init__(self, texels: int, grid: int = GRID) -> None:
        self._texels, self.block = texels, texels // grid
        self._used = np.zeros((grid, grid), dtype=bool)

    def take(self, texels: int) -> Place | None:
        """A free square for that many texels a side, or a smaller one if there is none."""
        for blocks in range(min(-(-texels // self.block), len(self._used)), 0, -1):
            windows = np.lib.stride_tricks.sliding_window_view(self._used, (blocks, blocks)).any(axis=(2, 3))
            free = np.argwhere(~windows)
            if len(free):
                place = Place(int(free[0][1]), int(free[0][0]), blocks)
                self._mark(place, True)
                return place
        return None

    def give_back(self, place: Place) -> None:
        self._mark(place, False)

    def viewport(self, place: Place, texels: int | None = None) -> tuple[int, int, int, int]:
        """x, y, width, height of the first texels of a place, or of all."""
        used = place.blocks * self.block if texels is None else texels
        return (place.column * self.block, place.row * self.block, used, used)

    def cell(self, place: Place, texels: int) -> tuple[float, float, float]:
        """u0, v0, size."""
        x, y, used, _ = self.viewport(place, texels)
        return (x / self._texels, y / self._texels, used / self._texels)

    def _mark(self, place: Place, used: bool) -> None:
        self._used[place.row:place.row + place.blocks, place.column:place.column + place.blocks] = used

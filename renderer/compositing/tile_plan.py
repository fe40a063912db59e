"""Which tiles of a frame are drawn with which program, in what order."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from renderer.objects.placement import TileMask, View
from renderer.shadows.shadow_atlas import ShadowMap

# Maps of lights and of the residual in one tile: each pair has a program of its own, and a tile takes the first that is enough.
# Few, because each has to be compiled before the first frame.
SLOTS = ((0, 1), (1, 1), (2, 2), (8, 4))
POINT_LAYOUT = (("tile", 3), ("maps_low", 4), ("maps_high", 4), ("ambients", 4), ("coverage_slot", 1))
ATLAS_COLUMNS = 32          # tiles a row of what is drawn
POINT_INTS = sum(count for _, count in POINT_LAYOUT)


class Batch(NamedTuple):
    """Points that are drawn by one program: of SLOTS; the mirrored view and the view of catchers that they show, or -1."""

    slots: tuple[int, int]
    mirrored: int
    catcher: int
    first: int
    points: int


@dataclass(frozen=True)
class TilePlan:
    """Touched tiles in atlas order, the points to draw, and per view (the last entry: no view) which with each program."""

    tiles: NDArray[np.intp]
    points: NDArray[np.int32]
    batches: list[list[Batch]]
    masks: list[TileMask]
    sizes: tuple[int, ...]      # views, light maps, mirrored views, views of catchers
    only: TileMask | None = None


def make_plan(views: list[View], maps: list[ShadowMap], ambient: list[ShadowMap], others: tuple[tuple[View, ...], ...],
              masks: list[TileMask], sizes: tuple[int, ...], only: TileMask | None = None) -> TilePlan:
    """`others`: the mirrored views, and those of catchers; a tile has one of each at most. `only`: the tiles that are wanted."""
    touched = np.logical_or.reduce(masks) if masks else np.zeros((0, 0), dtype=bool)
    tiles = np.argwhere(touched if only is None else touched & only)
    map_lists, ambient_lists = _reached(tiles, maps, SLOTS[-1][0]), _reached(tiles, ambient, SLOTS[-1][1])
    rows = np.concatenate([tiles[:, ::-1], np.arange(len(tiles))[:, None], map_lists, ambient_lists,
                           np.full((len(tiles), 1), -1)], axis=1).astype("i4")
    kinds = _slots(map_lists, ambient_lists)
    kinds = np.concatenate([kinds[:, None], np.full((len(tiles), 2), -1)], axis=1)
    for kind, group in enumerate(others, start=1):
        for index, view in enumerate(group):
            kinds[view.tiles[tiles[:, 0], tiles[:, 1]], kind] = index
    in_views = [view.tiles[tiles[:, 0], tiles[:, 1]] for view in views]
    slots = coverage_slots(views)
    no_view = ~np.logical_or.reduce(in_views) if in_views else np.ones(len(tiles), dtype=bool)
    points: list[NDArray[np.int32]] = [np.zeros((0, POINT_INTS), dtype="i4")]
    batches: list[list[Batch]] = []
    first = 0
    for members, slot in zip((*in_views, no_view), (*slots, None), strict=True):
        batches.append([])
        if slot is not None:
            rows[members, -1] = slot[tiles[members, 0], tiles[members, 1]]
        for kind in np.unique(kinds[members], axis=0):
            points.append(rows[members & (kinds == kind).all(axis=1)])
            batches[-1].append(Batch(SLOTS[kind[0]], int(kind[1]), int(kind[2]), first, len(points[-1])))
            first += len(points[-1])
    return TilePlan(tiles, np.concatenate(points), batches, masks, sizes, only)


def coverage_slots(views: list[View]) -> list[NDArray[np.intp]]:
    """Where the coverage of each tile of each view lies: (rows, columns) indices by view and tile alone, so that they stay as
    shadows come and go. Anything outside the view."""
    first = np.cumsum([0, *(view.tiles.sum() for view in views)])
    return [start + (np.cumsum(view.tiles) - 1).reshape(view.tiles.shape) for start, view in zip(first, views, strict=False)]


def coverage_points(views: list[View]) -> NDArray[np.int32]:
    """Points like those of a plan, for all tiles of the views, one view after another."""
    points = [np.zeros((0, POINT_INTS), dtype="i4")]
    for view, slots in zip(views, coverage_slots(views), strict=True):
        tiles = np.argwhere(view.tiles)
        points.append(np.full((len(tiles), POINT_INTS), -1, dtype="i4"))
        points[-1][:, :2], points[-1][:, -1] = tiles[:, ::-1], slots[view.tiles]
    return np.concatenate(points)


def _reached(tiles: NDArray[np.intp], touched: list[ShadowMap], most: int) -> NDArray[np.intp]:
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

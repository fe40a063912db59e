"""Pixels that show a mirror: where in the frame each of them looks is known from when it was drawn, only what is there is new in
every frame. A part of `kept_layers.py`."""

from __future__ import annotations

from collections.abc import Hashable

import numpy as np
from numpy.typing import NDArray

from renderer.compositing.composite import CompositeStage, GroundLight, Output
from renderer.frame import YuvFrame
from renderer.gl import Context
from renderer.light.radiance_map import RadianceMapStage
from renderer.native import kernels
from renderer.objects.placement import TileMask, View
from renderer.objects.shading import Drawn
from renderer.panorama import PanoramaTextures
from renderer.shadows.shadow_atlas import ShadowAtlases

_NO_GROUND = GroundLight(-1.0, np.ones(3), [])
_PIXELS = kernels.TILE**2
_FIRST = kernels.ADDED * _PIXELS        # of a tile's layers, of the added radiance


class MirroredPixels:
    """Owns the stage that finds the pixels, and what they show without the frame."""

    def __init__(self, context: Context, panorama: PanoramaTextures) -> None:
        self._stage = CompositeStage(context, panorama, Output.MIRRORS)
        self._panorama = panorama
        self._pixels = np.zeros(0, dtype=kernels.MIRRORED)
        self._keys: tuple[Hashable, ...] = ()
        self._views: list[View] = []    # live for as long as their ids are in the keys

    def take_out(self, layers: NDArray[np.float16]) -> None:
        """Leave in the layers what the pixels show without the frame."""
        flat = layers.reshape(-1)
        for channel in range(3):
            flat[self._pixels["at"] + channel * _PIXELS] = self._pixels["base"][:, channel]

    def find(self, drawn: list[Drawn], layers: NDArray[np.float16], atlases: ShadowAtlases, across: int) -> None:
        """Take over which pixels there are, and what the layers, drawn anew where they have changed, show in them."""
        showing = [one for one in drawn if one.mirrors is not None]
        keys = tuple((id(one.view), *(number for number, mirrors in zip(one.numbers, one.mirroring, strict=True) if mirrors))
                     for one in showing)
        if keys != self._keys:
            self._keys, self._views = keys, [one.view for one in showing]
            self._pixels = self._found(showing, atlases, across) if showing else self._pixels[:0]
        flat = layers.reshape(-1)
        for channel in range(3):
            self._pixels["base"][:, channel] = flat[self._pixels["at"] + channel * _PIXELS]

    def _found(self, showing: list[Drawn], atlases: ShadowAtlases, across: int) -> NDArray[np.void]:
        only: TileMask = np.logical_or.reduce([tiles for one in showing for tiles, mirrors in
                                               zip(one.view.member_tiles, one.mirroring, strict=True) if mirrors])
        by_view = {id(one.view): one for one in showing}
        tiles = self._stage.run([one.view for one in showing], lambda view: by_view[id(view)], [], [], _NO_GROUND, atlases,
                                only=only)
        places, shares = (self._stage.tiles(len(tiles), attachment) for attachment in (0, 1))
        tile, row, column = np.nonzero(places[..., 3] > 0.5)
        found = np.zeros(len(tile), dtype=kernels.MIRRORED)
        index = tiles[tile, 0] * across + tiles[tile, 1]
        found["at"] = index * kernels.LAYER_PLANES * _PIXELS + _FIRST + row * kernels.TILE + column
        found["u"], found["v"], found["width"] = np.moveaxis(places[tile, row, column, :3], -1, 0)
        found["share"] = shares[tile, row, column, :3]
        return found

    def put(self, frame: YuvFrame, radiance: RadianceMapStage, layers: NDArray[np.float16]) -> None:
        """Put into the layers what the pixels show of this frame."""
        if len(self._pixels):
            widest = float(self._pixels["width"].max())
            kernels.mirror(frame, radiance.newest(is_needed=widest > np.pi / radiance.size[0]), self._pixels, layers)

    def release(self) -> None:
        self._stage.release()

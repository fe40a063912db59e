"""What the objects do to each pixel, kept from frame to frame: a factor of the ground's light, and radiance that is added to it.

Both are the same for as long as light and objects are, and most of compositing is finding them: shadows looked up where a
pixel's ray meets the ground, objects where it meets their view. So they are drawn only for the tiles in which something is
another, and read back; what remains for every frame, the tone curve there and back, is done in the planes by `renderer/native`.
On a GPU, where drawing costs less than reading back, `composite.py` does all of it.

A layer has eight half floats a pixel: the factor of red, green and blue (additive: what is less of the tone curve's gain), the
share of the pixel that no object covers, the objects' radiance, and 1 where the pixel differs from the frame's. Tiles lie in
one array by their place in the frame; of what no tile ever touches the system keeps no memory.
"""

from __future__ import annotations

from collections.abc import Hashable

import numpy as np
from numpy.typing import NDArray

from renderer.compositing.composite import CompositeStage, DrawView, GroundLight, Output
from renderer.compositing.mirrored_pixels import MirroredPixels
from renderer.frame import YuvFrame
from renderer.gl import Context
from renderer.light.radiance_map import RadianceMapStage
from renderer.native import kernels
from renderer.objects.placement import TileMask, View, tile_grid
from renderer.objects.shading import Drawn
from renderer.panorama import PanoramaTextures
from renderer.shadows.catchers import CatcherLayer
from renderer.shadows.shadow_atlas import ShadowAtlases, ShadowMap

# of something that tiles show: those tiles, and the object whose identity stands in the key
Contents = dict[Hashable, tuple[TileMask, object]]


def keeps_layers(context: Context, panorama: PanoramaTextures) -> bool:
    """Whether this way of compositing is there and is the faster one."""
    return context.is_software and panorama.kind is YuvFrame and kernels.is_built()


class KeptLayers:
    """Owns the layers of one source geometry and the stage that draws them."""

    def __init__(self, context: Context, panorama: PanoramaTextures) -> None:
        self._stage = CompositeStage(context, panorama, Output.LAYERS)
        self._across, down = tile_grid(panorama.size)
        self._layers = np.zeros((down * self._across, kernels.LAYER_PLANES, kernels.TILE, kernels.TILE), dtype=np.float16)
        self._mirrored = MirroredPixels(context, panorama)
        self._contents: Contents = {}
        self._touched = np.zeros((down, self._across), dtype=bool)
        self._places = np.zeros(0, dtype=np.int32)
        self._additive = False

    def run(self, views: list[View], draw_view: DrawView, maps: list[ShadowMap], ambient: list[ShadowMap], ground: GroundLight,
            atlases: ShadowAtlases, catchers: CatcherLayer | None) -> NDArray[np.int32]:
        """Draw what is another than in the last frame. Returns the touched tiles, as indices into the frame's grid of them."""
        drawn = {id(view): draw_view(view) for view in views}
        contents = self._contents_of(list(drawn.values()), maps, ambient, ground, catchers)
        changed = self._changed(contents)
        self._contents, self._additive = contents, ground.additive
        if changed.any():
            self._touched = _union([mask for mask, _ in contents.values()], self._touched.shape)
            self._places = np.flatnonzero(self._touched).astype(np.int32)
            self._mirrored.take_out(self._layers)
            self._keep(self._stage.run(views, lambda view: drawn[id(view)], maps, ambient, ground, atlases, catchers=catchers,
                                       only=changed))
            self._mirrored.find(list(drawn.values()), self._layers, atlases, self._across)
        return self._places

    def write(self, frame: YuvFrame, source: YuvFrame, radiance: RadianceMapStage) -> None:
        """Composite the layers into the planes, in place. `source`: what mirrors show."""
        self._mirrored.put(source, radiance, self._layers)
        kernels.composite(frame, self._layers, self._places, self._across, additive=self._additive)

    def _contents_of(self, drawn: list[Drawn], maps: list[ShadowMap], ambient: list[ShadowMap], ground: GroundLight,
                     catchers: CatcherLayer | None) -> Contents:
        """All that tiles show, by keys that are others when it is another."""
        contents: Contents = {("view", id(one.view)): (one.view.tiles, one.view) for one in drawn}
        for one in drawn:
            for number, tiles in zip(one.numbers, one.view.member_tiles, strict=True):
                contents["object", number] = (tiles, one.view)
        light = (ground.y, ground.total.tobytes(), ground.additive)
        for shadow in maps:     # one that is drawn anew has another array of tiles
            key = ("light", id(shadow.tiles), shadow.rect, shadow.cell, light, ground.lights[shadow.light].tobytes())
            contents[key] = (shadow.tiles, shadow.tiles)
        for shadow in ambient:
            contents["ambient", id(shadow), light] = (shadow.tiles, shadow)
        if catchers is not None:
            for view in catchers.views:
                contents["catcher", id(view), catchers.picture(view)[1]] = (view.tiles, view)
        return contents

    def _changed(self, contents: Contents) -> TileMask:
        """The tiles that show something that has come or gone."""
        old = self._contents
        return _union([mask for key, (mask, _) in contents.items() if key not in old]
                      + [mask for key, (mask, _) in old.items() if key not in contents], self._touched.shape)

    def _keep(self, tiles: NDArray[np.intp]) -> None:
        """Take over the tiles that have been drawn, in the order of their slots."""
        if len(tiles):
            factors, addends = self._stage.layers(len(tiles))
            places = (tiles[:, 0] * self._across + tiles[:, 1]).astype(np.int32)
            kernels.keep_layers(factors, addends, np.arange(len(tiles), dtype=np.int32), places, self._layers)

    def compile_variants(self) -> None:
        """See CompositeStage."""
        self._stage.compile_variants()

    def release(self) -> None:
        self._stage.release()
        self._mirrored.release()


def _union(masks: list[TileMask], shape: tuple[int, ...]) -> TileMask:
    return np.logical_or.reduce(masks) if masks else np.zeros(shape, dtype=bool)

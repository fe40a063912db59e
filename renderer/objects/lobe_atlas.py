"""The prefiltered maps of a frame's light in one texture, so that every roughness in use is one look-up away."""

from __future__ import annotations

import moderngl
import numpy as np

from renderer.gl import Context
from renderer.light.specular import Array32, Lobe, quantized_roughness

MAX_LOBES = 16             # roughness values in one frame; as in shade.frag.glsl
Cell = tuple[float, float, float]       # u scale, v offset, v scale
NOWHERE: Cell = (0.0, 0.0, 0.0)


class LobeAtlas:
    """Owns the texture: irradiance, then the lobes by rising roughness, what is under the horizon beside what is over it."""

    def __init__(self, context: Context) -> None:
        self._context = context
        self.texture: moderngl.Texture = context.texture((1, 1), 4, "f4")
        self.uniforms: dict[str, object] = {}
        self.sharpest = NOWHERE
        self._cells: dict[float, Cell] = {}

    def __bool__(self) -> bool:
        return bool(self._cells)

    def cell(self, roughness: float) -> Cell | None:
        """Where the map of that roughness is, None if there is none."""
        return self._cells.get(quantized_roughness(roughness))

    def fill(self, irradiance: Array32, lobes: dict[float, Lobe]) -> None:
        """Take over the maps of a frame."""
        pairs = [(irradiance, irradiance), *((lobe.above, lobe.below) for _, lobe in sorted(lobes.items())[:MAX_LOBES])]
        width = max(left.shape[1] for left, _ in pairs) + 2
        height = sum(left.shape[0] + 2 for left, _ in pairs)
        atlas = np.zeros((height, 2 * width, 4), dtype="f4")
        cells, top = [], 0
        for pair in pairs:
            rows, columns = pair[0].shape[:2]
            for side, one in enumerate(pair):
                _bordered(one, atlas[top:top + rows + 2, side * width:side * width + columns + 2, :one.shape[2]])
            cells.append((columns / (2 * width), (top + 1) / height, rows / height))
            top += rows + 2
        self._cells = dict(zip(sorted(lobes), cells[1:], strict=False))
        self.sharpest = cells[min(1, len(cells) - 1)]
        table = np.zeros((MAX_LOBES, 4))
        for index, (roughness, cell) in enumerate(self._cells.items()):
            table[index] = (roughness, *cell)
        if self.texture.size != (2 * width, height):
            self.texture.release()
            self.texture = self._context.texture((2 * width, height), 4, "f4")
        self.texture.write(atlas)
        self.uniforms = {"lobe_count": len(self._cells), "lobe": table, "lobe_border": 0.5 / width, "irradiance_cell": cells[0]}

    def release(self) -> None:
        self.texture.release()


def _bordered(one: Array32, cell: Array32) -> None:
    """Write a map into a cell of the atlas that is two texels larger, with what lies across its seam and its poles around it."""
    half = one.shape[1] // 2
    cell[1:-1, 1:-1] = one
    cell[0, 1:-1], cell[-1, 1:-1] = np.roll(one[0], half, axis=0), np.roll(one[-1], half, axis=0)
    cell[:, 0], cell[:, -1] = cell[:, -2], cell[:, 1]

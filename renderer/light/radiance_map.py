"""The radiance map: the frame's light on a small equirectangular grid, the input of every lighting stage.

Inverse tone mapping is fused with the reduction; a full-resolution HDR frame never exists. The planes are read eight pixels a
fetch, and polynomials stand in for pow(). Where OpenGL is software, the processor does the same directly (`renderer/native`).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from functools import cached_property

import moderngl
import numpy as np
from numpy.typing import NDArray

from renderer.frame import Frame, YuvFrame
from renderer.gl import Context, release_all, set_uniforms
from renderer.light.inverse_tone_mapping import luminance_of
from renderer.native.kernels import is_built, reduce_planes
from renderer.panorama import PanoramaTextures

TARGET_WIDTH = 256
Floats = NDArray[np.floating]


@dataclass(frozen=True)
class RadianceMap:
    """`rgb`: (height, width, 3) mean radiance; `clipped`: (height, width) share of each texel at the camera's limit; `raised`:
    (height, width) factor by which `highlights.py` has raised it (None: it has not).

    Single precision as the GPU gives it, or double; what adds up many texels does so in double.
    """

    rgb: Floats
    clipped: Floats
    raised: Floats | None = None

    @cached_property
    def luminance(self) -> Floats:
        """(height, width) by the papers' weights."""
        return luminance_of(self.rgb)


def map_size(frame_size: tuple[int, int]) -> tuple[int, int]:
    """Width and height of the map: about 256 wide, whole blocks of pixels where the frame's size allows."""
    width, height = frame_size
    if width <= TARGET_WIDTH:
        return width, min(height, max(1, width // 2))
    blocks = [b for b in range(2, width) if width % b == 0 and width / b >= 160]
    best = min(blocks, key=lambda b: (b % 4 != 0, abs(width / b - TARGET_WIDTH)), default=None)
    map_width = width // best if best and abs(width / best - TARGET_WIDTH) < 100 else TARGET_WIDTH
    return map_width, min(height, map_width // 2)


def packed_pixels(kind: type[Frame], size: tuple[int, int]) -> int:
    """How many pixels a texel of the packed planes should hold for the reduction to a map: 8, 4, or 0 for none."""
    if kind is not YuvFrame or size[0] % 4:
        return 0
    return 8 if size[0] % (8 * map_size(size)[0]) == 0 else 4


def cells_of_texel(frame_size: tuple[int, int], size: tuple[int, int], packed: int) -> tuple[int, int]:
    """Columns and rows of cells, of `packed` x 2 pixels or of one, that make a texel of a map of `size`; 0 where that is no whole
    number."""
    cell = (packed, 2) if packed else (1, 1)
    counts = [frame // (texels * side) for frame, texels, side in zip(frame_size, size, cell, strict=True)]
    whole = all(count * texels * side == frame for count, frame, texels, side in zip(counts, frame_size, size, cell, strict=True))
    return (counts[0], counts[1]) if whole else (0, 0)


class Way(Enum):
    """How a frame is reduced: in C where OpenGL is software; by a group of invocations a texel on a GPU; by one each, anywhere."""

    PROCESSOR = "processor"
    COMPUTE = "compute"
    FRAGMENT = "fragment"


class RadianceMapStage:
    """Owns the reduction pass of one source geometry."""

    def __init__(self, context: Context, panorama: PanoramaTextures, size: tuple[int, int] | None = None,
                 way: Way | None = None) -> None:
        """`size`: of the map, None for the usual one. `way`: None for the fastest that the sizes allow. Raises ValueError when
        they do not allow the one that is given."""
        self._context, self._panorama = context, panorama
        self.size = map_size(panorama.size) if size is None else size
        columns, rows = cells_of_texel(panorama.size, self.size, panorama.packed)
        defines = {**panorama.defines, "COLUMNS": columns, "ROWS": rows}
        self._program = context.program("full_screen.vert.glsl", "radiance_map.frag.glsl", defines)
        self.texture = context.texture(self.size, 4, "f4", wrap_x=True)
        self.way = self._fastest(is_whole=columns > 0) if way is None else way
        self._compute: moderngl.ComputeShader | None = None
        if self.way is Way.COMPUTE:
            if not columns:
                raise ValueError(f"map of a {panorama.size} frame is {self.size}, expected whole cells for a compute shader")
            invocations = min(32, 1 << (columns * rows - 1).bit_length())
            self._compute = context.compute("radiance_map.comp.glsl", {**defines, "INVOCATIONS": invocations})
        self._newest = np.zeros((self.size[1], self.size[0], 4), dtype=np.float32)
        self._newest_of: Frame | None = None    # the frame
        self._target = context.gl.framebuffer([self.texture])
        self._triangle = context.gl.vertex_array(self._program, [])

    def _fastest(self, *, is_whole: bool) -> Way:
        if not self._context.is_software:
            return Way.COMPUTE if is_whole else Way.FRAGMENT
        blocks = all(frame % (2 * texels) == 0 for frame, texels in zip(self._panorama.size, self.size, strict=True))
        return Way.PROCESSOR if blocks and self._panorama.kind is YuvFrame and is_built() else Way.FRAGMENT

    def run(self) -> RadianceMap:
        """Reduce the frame that the panorama shows. The full map also stays in `texture` for mirrors."""
        frame = self._panorama.frame
        if self.way is Way.PROCESSOR and isinstance(frame, YuvFrame):
            texels = reduce_planes(frame, self.size)
            self.texture.write(texels)
        else:
            texels = self._draw(self.size[1])
        self._newest, self._newest_of = texels, frame
        return RadianceMap(np.ascontiguousarray(texels[..., :3]), np.ascontiguousarray(texels[..., 3]))

    def newest(self, *, is_needed: bool) -> NDArray[np.float32]:
        """(height, width, 4) of the frame that the panorama shows if it `is_needed`, from every second row of 2 x 2 pixels, which
        is enough to look at; else of some frame."""
        frame = self._panorama.frame
        if is_needed and self._newest_of is not frame and self.way is Way.PROCESSOR and isinstance(frame, YuvFrame):
            self._newest, self._newest_of = reduce_planes(frame, self.size, every=2), frame
        return self._newest

    def run_rows(self, rows: int) -> NDArray[np.float32]:
        """Only the uppermost rows: (rows, width, 3) radiance."""
        return self._draw(rows)[..., :3]

    def _draw(self, rows: int) -> NDArray[np.float32]:
        self._panorama.upload()
        if self._compute is not None:
            self._panorama.bind(self._compute)
            self.texture.bind_to_image(0, read=False, write=True)
            self._compute.run(self.size[0], rows)
            self._context.gl.memory_barrier()
        else:
            self._panorama.bind(self._program)
            set_uniforms(self._program, {"map_size": self.size})
            self._target.use()
            self._target.viewport = (0, 0, self.size[0], rows)
            self._triangle.render(moderngl.TRIANGLES, 3)
        pixels = np.frombuffer(self._target.read((0, 0, self.size[0], rows), components=4, dtype="f4"), dtype="f4")
        return pixels.reshape(rows, self.size[0], 4)

    def release(self) -> None:
        self._context.rest()
        release_all(self._triangle, self._target, self.texture, self._program, self._compute)

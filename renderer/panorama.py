"""The source frame on the GPU: upload of its planes, and the sampler uniforms that `shaders/panorama.glsl` declares."""

from __future__ import annotations

import moderngl
import numpy as np

from renderer.color import YuvFormat
from renderer.frame import Frame, RgbFrame, YuvFrame, check_size
from renderer.gl import Context, release_all, set_uniforms
from renderer.light.inverse_tone_mapping import INVERSE_TABLE_SIZE, inverse_gain_table


class PanoramaTextures:
    """Owns the textures of one source geometry; `show` takes over a frame, `upload` puts it there if that has not been done yet,
    `bind` makes it visible to a program."""

    FIRST_UNIT = 0  # units 0 to 6

    def __init__(self, context: Context, kind: type[Frame], size: tuple[int, int], packed: int = 0) -> None:
        self.kind = kind
        self.size = size
        width, height = size
        self.packed = packed   # pixels that share a texel of the packed planes, which the reduction reads: 8, 4, or 0 for none
        self._packed: list[moderngl.Texture] = []
        if kind is YuvFrame:
            sizes = [(width, height), (width // 2, height // 2), (width // 2, height // 2)]
            self._planes = [context.texture(s, 1, "f1", wrap_x=True) for s in sizes]
            if self.packed:
                luma, chroma = {8: ((2, "u4"), (1, "u4")), 4: ((1, "u4"), (1, "u2"))}[self.packed]
                self._packed = [context.texture((width // self.packed, rows), components, dtype, linear=False)
                                for rows, (components, dtype) in ((height, luma), (height // 2, chroma), (height // 2, chroma))]
        else:
            self._planes = [context.texture(size, 4, "f1" if kind is RgbFrame else "f4", wrap_x=True)]
        self._inverse_gain = context.texture((INVERSE_TABLE_SIZE, 1), 1, "f4")
        self._inverse_gain.write(inverse_gain_table().tobytes())
        self.format = YuvFormat()
        self._frame: Frame | None = None
        self._missing: set[moderngl.Texture] = set()    # that do not have the frame yet
        self._bound: dict[int, YuvFormat] = {}

    @property
    def defines(self) -> dict[str, int]:
        """The preprocessor switches of `panorama.glsl`."""
        return {"SOURCE_YUV": int(self.kind is YuvFrame), "SOURCE_RGB8": int(self.kind is RgbFrame), "PACKED": self.packed}

    def show(self, frame: Frame) -> None:
        """From now on the textures mean this frame, whose arrays must stay as they are until the next one.

        Raises ValueError when the frame's size is not that of the textures.
        """
        check_size(frame)
        if type(frame) is not self.kind or frame.size != self.size:
            raise ValueError(f"frame is {type(frame).__name__} {frame.size}, expected {self.kind.__name__} {self.size}")
        self._frame, self._missing = frame, {*self._planes, *self._packed}
        if isinstance(frame, YuvFrame):
            self.format = frame.format

    @property
    def frame(self) -> Frame:
        assert self._frame is not None
        return self._frame

    def upload(self, *, packed: bool = True, plain: bool = False) -> None:
        """Upload and bind the frame, `packed` where there are such planes and, for those who interpolate in them, `plain`."""
        frame = self.frame
        if isinstance(frame, YuvFrame):
            wanted = [*(self._packed if packed else []), *(self._planes if plain or not self.packed else [])]
            for texture in wanted:
                index = (*self._packed, *self._planes).index(texture)
                if texture in self._missing:
                    texture.write(np.ascontiguousarray((frame.y, frame.u, frame.v)[index % 3]), alignment=1)
                    self._missing.remove(texture)
        elif self._missing:
            rgba = np.zeros((*frame.rgb.shape[:2], 4), dtype=frame.rgb.dtype)
            rgba[..., :3] = frame.rgb
            self._planes[0].write(rgba)
            self._missing.clear()
        # nothing else uses their units
        for unit, texture in enumerate((*self._planes, *self._packed), start=self.FIRST_UNIT):
            texture.use(unit)
        self._inverse_gain.use(self.FIRST_UNIT + 6)

    def bind(self, program: moderngl.Program | moderngl.ComputeShader) -> None:
        """Tell a program where the frame is, and the meaning of its codes when that has changed."""
        if self._bound.get(program.glo) == self.format:
            return
        names = ("luma_plane", "u_plane", "v_plane", "packed_luma", "packed_u", "packed_v") if self.kind is YuvFrame else (
            "rgb_plane",)
        set_uniforms(program, {name: unit for unit, name in enumerate(names, start=self.FIRST_UNIT)})
        set_uniforms(program, {"inverse_gain_table": self.FIRST_UNIT + 6, "frame_size": self.size,
                               "rgb_from_yuv": self.format.rgb_from_yuv().T})  # GL stores columns
        self._bound[program.glo] = self.format

    def release(self) -> None:
        release_all(*self._planes, *self._packed, self._inverse_gain)

"""The papers' source of glossy light: the whole frame as radiance with a chain of mip levels, made anew for every frame.

Iorns & Rhee 2015, sections 3.2 and 5; `shaders/rings.glsl` samples it. The baseline of `specular.py`. As in the paper every
reflected ray, a mirror's too, looks up the distant frame: no ground plane, no shadows on it, no neighbours.
"""

from __future__ import annotations

import moderngl
import numpy as np
from numpy.typing import NDArray

from renderer.gl import Context, release_all, set_uniforms
from renderer.panorama import PanoramaTextures

KEPT_UNIT = 8   # after the panorama's


class RingSource:
    """Owns the full-resolution texture and the pass that fills it."""

    def __init__(self, context: Context, panorama: PanoramaTextures, map_size: tuple[int, int]) -> None:
        self._panorama = panorama
        self._program = context.program("full_screen.vert.glsl", "full_radiance.frag.glsl", panorama.defines)
        self._triangle = context.gl.vertex_array(self._program, [])
        self.texture = context.texture(panorama.size, 4, "f2", wrap_x=True)
        self._target = context.gl.framebuffer([self.texture])
        self._kept = context.texture(map_size, 1, "f4", wrap_x=True)

    def fill(self, kept: NDArray[np.float32], clamp_luminance: float) -> None:
        """From the frame in the panorama's planes. `kept`: (height, width) share of the radiance that is no light's, for which a
        `clamp_luminance` above 0 stands in."""
        self._kept.write(np.ascontiguousarray(kept))
        self._kept.use(KEPT_UNIT)
        self._panorama.upload(plain=True)
        self._panorama.bind(self._program)
        set_uniforms(self._program, {"kept": KEPT_UNIT, "clamp_luminance": clamp_luminance})
        self._target.use()
        self._triangle.render(moderngl.TRIANGLES, 3)
        self.texture.build_mipmaps()
        self.texture.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)

    def release(self) -> None:
        release_all(self._triangle, self._target, self.texture, self._kept, self._program)

"""What mirrors show of the frame, anew in every frame, though they are shaded only when their light or their place is another."""

from __future__ import annotations

from weakref import WeakKeyDictionary

import moderngl

from renderer.gl import Context, release_all, set_uniforms
from renderer.objects.placement import View
from renderer.objects.surfaces import FIRST_UNIT, ViewTarget
from renderer.panorama import PanoramaTextures

Rectangle = tuple[int, int, int, int]


class _Buffers:
    """Of one view's mirrors: what is not mirrored, where each pixel looks, and how much of what is there it gives back."""

    def __init__(self, context: Context, size: tuple[int, int]) -> None:
        self.textures = [context.texture(size, 4, dtype, linear=False) for dtype in ("f2", "f4", "f2")]
        self.framebuffer = context.gl.framebuffer(self.textures)
        self.view: View | None = None

    def release(self) -> None:
        release_all(self.framebuffer, *self.textures)


class MirrorStage:
    """Owns the program and the buffers of every view's mirrors."""

    def __init__(self, context: Context, panorama: PanoramaTextures, radiance_texture: moderngl.Texture) -> None:
        self._context, self._panorama, self._radiance_texture = context, panorama, radiance_texture
        self._programs = {apart: context.program("full_screen.vert.glsl", "mirror.frag.glsl",
                                                 {**panorama.defines, "APART": int(apart)}) for apart in (False, True)}
        self._triangles = {apart: context.gl.vertex_array(program, []) for apart, program in self._programs.items()}
        self._buffers: WeakKeyDictionary[ViewTarget, _Buffers] = WeakKeyDictionary()

    def framebuffer(self, target: ViewTarget, view: View) -> moderngl.Framebuffer:
        """Where a view's mirrors are shaded into."""
        if target not in self._buffers:
            self._buffers[target] = _Buffers(self._context, target.texture.size)
        buffers = self._buffers[target]
        if buffers.view is not view:
            buffers.view = view
            buffers.framebuffer.use()
            buffers.framebuffer.clear()
        return buffers.framebuffer

    def rays(self, target: ViewTarget) -> tuple[moderngl.Texture, moderngl.Texture] | None:
        """Where the pixels of a view's mirrors look (alpha: 1 for a mirror's), and how much of what is there they give back."""
        buffers = self._buffers.get(target)
        return None if buffers is None else (buffers.textures[1], buffers.textures[2])

    def show(self, target: ViewTarget, view: View, rectangle: Rectangle, *, apart: bool) -> None:
        """Fill in a rectangle of the view's picture, with what is seen of the frame or, where that is put in apart, without."""
        buffers, program = self._buffers[target], self._programs[apart]
        target.shaded.use()
        target.shaded.viewport = (0, 0, *view.size)
        self._panorama.bind(program)
        textures = zip(("shaded", "mirror_ray", "mirror_share", "radiance_map"), (*buffers.textures, self._radiance_texture),
                       strict=True)
        for unit, (name, texture) in enumerate(textures, start=FIRST_UNIT):
            texture.use(unit)
            set_uniforms(program, {name: unit})
        target.shaded.scissor = rectangle
        self._triangles[apart].render(moderngl.TRIANGLES, 3)
        target.shaded.scissor = (0, 0, *target.texture.size)

    def release(self) -> None:
        self._context.rest()
        release_all(*self._buffers.values(), *self._triangles.values(), *self._programs.values())

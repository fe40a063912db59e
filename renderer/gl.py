"""The GL context, the strict shader loader and the few GL objects that every stage shares.

A context belongs to the thread that made it. Everything here is OpenGL 4.3 core over EGL without a window: Mesa's llvmpipe
on any machine, an NVIDIA driver where there is one.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Mapping
from importlib import resources
from typing import Any, Protocol

import moderngl
import numpy as np

GL_CLIP_DISTANCE0 = 0x3000  # for enable_direct; moderngl has no name for it
SOFTWARE_RENDERERS = ("llvmpipe", "softpipe", "swrast", "swiftshader")
_INCLUDE = re.compile(r'^\s*#include\s+"([^"]+)"\s*$')
_LOG_LINE = re.compile(r"(?:(?<=^)|(?<=ERROR: ))(\d+)[:(](\d+)\)?", re.MULTILINE)


class GLUnavailableError(RuntimeError):
    """No usable OpenGL; the message says what to install."""


class ShaderError(RuntimeError):
    """A shader does not load or compile; the message names file and line."""


class Context:
    """A headless OpenGL context that checks that only its own thread uses it.

    Raises GLUnavailableError when there is no EGL or OpenGL 4.3, or when `require_gpu` finds a software renderer.
    """

    def __init__(self, *, require_gpu: bool = False) -> None:
        try:
            egl: dict[str, Any] = {"backend": "egl", "libgl": "libGL.so.1", "libegl": "libEGL.so.1"}
            self.gl = moderngl.create_context(standalone=True, require=430, **egl)
        except Exception as error:  # glcontext raises bare Exception for everything from a missing library to no device
            raise GLUnavailableError(
                f"no OpenGL 4.3 over EGL ({error}); install the packages libgl1 libegl1 libegl-mesa0 libgl1-mesa-dri"
            ) from None
        self.gl.gc_mode = "context_gc"
        self.renderer = str(self.gl.info["GL_RENDERER"])
        self.version = str(self.gl.info["GL_VERSION"])
        self._thread = threading.get_ident()
        self._resting_target = self.gl.simple_framebuffer((1, 1))
        if require_gpu and self.is_software:
            self.gl.release()
            raise GLUnavailableError(f"GL_RENDERER is {self.renderer!r}, expected a GPU (--require-gpu)")

    @property
    def is_software(self) -> bool:
        return any(name in self.renderer.lower() for name in SOFTWARE_RENDERERS)

    def assert_own_thread(self) -> None:
        if threading.get_ident() != self._thread:
            raise RuntimeError("the GL context is used outside the thread that made it")

    def program(self, vertex: str, fragment: str, defines: Mapping[str, int] | None = None) -> moderngl.Program:
        """Compile and link two files of `renderer/shaders`. Raises ShaderError."""
        sources = [load_shader(name, defines) for name in (vertex, fragment)]
        try:
            return self.gl.program(vertex_shader=sources[0].text, fragment_shader=sources[1].text)
        except moderngl.Error as error:
            files = sources[1].files if "fragment_shader" in str(error) else sources[0].files
            raise ShaderError(_LOG_LINE.sub(lambda m: _named_line(m, files), str(error))) from None

    def compute(self, name: str, defines: Mapping[str, int] | None = None) -> moderngl.ComputeShader:
        """Compile one file of `renderer/shaders`. Raises ShaderError."""
        source = load_shader(name, defines)
        try:
            return self.gl.compute_shader(source.text)
        except moderngl.Error as error:
            raise ShaderError(_LOG_LINE.sub(lambda m: _named_line(m, source.files), str(error))) from None

    def texture(self, size: tuple[int, int], components: int, dtype: str, *, linear: bool = True,
                wrap_x: bool = False) -> moderngl.Texture:
        texture = self.gl.texture(size, components, dtype=dtype)
        texture.filter = (moderngl.LINEAR, moderngl.LINEAR) if linear else (moderngl.NEAREST, moderngl.NEAREST)
        texture.repeat_x = wrap_x
        texture.repeat_y = False
        return texture

    def rest(self) -> None:
        """Bind a target of our own before another is released: moderngl binds the last one again whenever it makes a new one."""
        self._resting_target.use()

    def start(self) -> None:
        """Have the driver begin with what has been drawn so far, without waiting for it: glFlush, which moderngl lacks.

        A software renderer begins only when it must, and drawing to another target is such a reason.
        """
        self._resting_target.use()
        self._resting_target.clear()

    def collect(self) -> None:
        """Free the GL objects that Python has dropped since the last call; once a frame.

        In place of moderngl's own `gc`, which fails on objects that were released before they were dropped (5.13.0).
        """
        while self.gl.objects:
            dropped = self.gl.objects.popleft()
            if hasattr(dropped, "release"):
                dropped.release()

    def release(self) -> None:
        self.collect()
        self.gl.release()


class ShaderSource:
    """GLSL text with every include resolved, and the names that its #line numbers refer to."""

    def __init__(self, text: str, files: list[str]) -> None:
        self.text = text
        self.files = files


def load_shader(name: str, defines: Mapping[str, int] | None = None) -> ShaderSource:
    """Read `name` of `renderer/shaders`, each included file once. Raises ShaderError naming file and line."""
    files: list[str] = []
    body = _resolve(name, files, included_from="")
    header = "#version 430 core\n" + "".join(f"#define {key} {value}\n" for key, value in (defines or {}).items())
    return ShaderSource(header + body, files)


def _resolve(name: str, files: list[str], included_from: str) -> str:
    if name in files:
        return ""
    path = resources.files("renderer.shaders") / name
    if not path.is_file():
        raise ShaderError(f"{included_from}shader {name!r} does not exist in renderer/shaders")
    index = len(files)
    files.append(name)
    lines = [f"#line 1 {index}"]
    for number, line in enumerate(path.read_text().splitlines(), start=1):
        if match := _INCLUDE.match(line):
            lines.append(_resolve(match.group(1), files, included_from=f"{name}:{number}: "))
            lines.append(f"#line {number + 1} {index}")
        else:
            lines.append(line)
    return "\n".join(lines) + "\n"


def _named_line(match: re.Match[str], files: list[str]) -> str:
    index, line = int(match.group(1)), match.group(2)
    return f"{files[index]}:{line}" if index < len(files) else match.group(0)


class Releasable(Protocol):
    """What every GL object is."""

    def release(self) -> None: ...


def release_all(*items: Releasable | None) -> None:
    for item in items:
        if item is not None:
            item.release()


def set_uniforms(program: moderngl.Program | moderngl.ComputeShader, values: Mapping[str, object]) -> None:
    """Set uniforms by name. One that the compiler has removed as unused is skipped; moderngl checks the others' shapes."""
    for name, value in values.items():
        member = program.get(name, None)
        if not isinstance(member, moderngl.Uniform):
            continue
        if isinstance(value, np.ndarray):
            used = value.ravel()[:member.array_length * member.dimension]   # the compiler cuts an array to what it reads
            member.write(np.ascontiguousarray(used, dtype="f4").tobytes())
        else:
            member.value = value

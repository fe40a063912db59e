"""The functions in C; all else about the package stands in pyproject.toml."""

from setuptools import Extension, setup

KERNELS = Extension(    # called by ctypes, see renderer/native/kernels.py
    "renderer.native._kernels", [f"renderer/native/{name}.c" for name in ("composite", "mirror", "moments", "radiance_map")],
    depends=["renderer/native/planes.h", "renderer/native/tone.h"],
    extra_compile_args=["-O3", "-fno-math-errno", "-fno-trapping-math"],
    optional=True)      # without a compiler OpenGL does their work

setup(ext_modules=[KERNELS])

"""Meshes on the GPU, and where they stand in the world."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import moderngl
import numpy as np
from numpy.typing import NDArray

from renderer.gl import Context, release_all
from renderer.mesh import Mesh, Primitive, Surface

Array = NDArray[np.float64]
_ATTRIBUTES = (("position", 3), ("normal", 3), ("uv", 2))


@dataclass(frozen=True)
class PlacedMesh:
    """A mesh in the world. `surface` replaces the mesh's own surfaces when it is not None."""

    mesh: GpuMesh
    world_from_model: Array
    surface: Surface | None

    @property
    def surfaces(self) -> list[Surface]:
        return [self.surface] if self.surface else [part.surface for part in self.mesh.parts]

    @property
    def is_textured(self) -> bool:
        """Whether its surface differs from point to point."""
        return self.surface is None and any(part.is_textured for part in self.mesh.parts)

    def parts(self) -> list[tuple[GpuPart, Surface]]:
        """What to draw, each with the surface that it has here."""
        return [(part, self.surface or part.surface) for part in self.mesh.parts]

    @property
    def is_mirrored(self) -> bool:
        """Whether its triangles wind the other way round in the world."""
        return bool(np.linalg.det(self.world_from_model[:3, :3]) < 0)

    def matrices(self) -> dict[str, object]:
        """Uniforms of the vertex shaders."""
        return {"world_from_model": self.world_from_model.T,
                "normal_from_model": np.linalg.inv(self.world_from_model[:3, :3])}  # its transpose, in GL's column order


class GpuMesh:
    """Vertex buffers and textures of one mesh. `programs`: all that draw meshes, by name."""

    def __init__(self, context: Context, programs: Mapping[str, moderngl.Program], mesh: Mesh) -> None:
        self.mesh = mesh
        self.parts = [GpuPart(context, programs, primitive) for primitive in mesh.primitives]

    def release(self) -> None:
        release_all(*self.parts)


class GpuPart:
    """One primitive: `vertex_arrays` by the name of the program."""

    def __init__(self, context: Context, programs: Mapping[str, moderngl.Program], primitive: Primitive) -> None:
        gl = context.gl
        self.surface = s = primitive.surface
        self.textures = [_material_texture(context, image) for image in
                         (s.base_color_texture, s.metallic_roughness_texture, s.emissive_texture)]
        vertices = np.concatenate([primitive.positions, primitive.normals, primitive.uvs], axis=1).astype("f4")
        self._vertices, self._indices = gl.buffer(vertices.tobytes()), gl.buffer(primitive.triangles.astype("i4").tobytes())
        self.vertex_arrays = {name: gl.vertex_array(program, [self._layout(program)], index_buffer=self._indices,
                                                    index_element_size=4) for name, program in programs.items()}

    def _layout(self, program: moderngl.Program) -> tuple[object, ...]:
        used = [name for name, _ in _ATTRIBUTES if name in program]
        return (self._vertices, " ".join(f"{n}f" if name in program else f"{4 * n}x" for name, n in _ATTRIBUTES), *used)

    @property
    def is_textured(self) -> bool:
        return any(texture is not None for texture in self.textures) or self.surface.alpha_cutoff is not None

    def release(self) -> None:
        release_all(*self.vertex_arrays.values(), self._vertices, self._indices, *self.textures)


def _material_texture(context: Context, image: NDArray[np.uint8] | None) -> moderngl.Texture | None:
    if image is None:
        return None
    texture = context.gl.texture((image.shape[1], image.shape[0]), 4, np.ascontiguousarray(image).tobytes())
    texture.build_mipmaps()
    texture.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)
    return texture

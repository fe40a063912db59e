"""Meshes on the GPU, and where they stand in the world."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import get_args

import moderngl
import numpy as np
from numpy.typing import NDArray

from renderer.gl import Context, release_all
from renderer.models.mesh import Mesh, Primitive, Slot, Surface, Texture
from renderer.models.skeleton import Pose, Posed

Array = NDArray[np.float64]
SRGB8_ALPHA8 = 0x8C43      # moderngl has no name for it
SLOTS: tuple[Slot, ...] = get_args(Slot)
_IN_SRGB = ("base_color", "emissive")
_MOVING = (("position", 3), ("normal", 3), ("tangent", 4))
_STILL = (("openness", 2), ("uv", 2), ("uv2", 2), ("color", 4))
ROUGHNESS_PERCENTILES = (2.0, 35.0, 65.0, 98.0)
_NO_TANGENT = (1.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True)
class PlacedMesh:
    """A mesh in the world. `surface` replaces the mesh's own surfaces when it is not None; `pose` is that of its vertices, None at
    rest, and `pose_number` another one for every pose."""

    mesh: GpuMesh
    world_from_model: Array
    surface: Surface | None
    pose: Pose | None = None
    pose_number: int = 0

    @property
    def surfaces(self) -> list[Surface]:
        return [self.surface] if self.surface else [part.surface for part in self.mesh.parts]

    @property
    def roughnesses(self) -> set[float]:
        """Those that its surfaces have, a few for one that is textured with it."""
        if self.surface is not None:
            return {self.surface.roughness}
        return {value for part in self.mesh.parts for value in part.roughnesses}

    @property
    def is_detailed(self) -> bool:
        """Whether its surface differs from point to point, or lets light through."""
        return self.surface is None and any(part.is_detailed for part in self.mesh.parts)

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

    def outline(self) -> Array:
        """(n, 3) points of the world whose projections bound its own."""
        mesh = self.mesh.mesh
        points = mesh.outline if self.pose is None else mesh.posed_outline(self.pose)
        return np.asarray(points @ self.world_from_model[:3, :3].T + self.world_from_model[:3, 3])

    def state(self) -> bytes:
        """Equal for two that look the same, as long as their meshes exist."""
        return self.world_from_model.tobytes() + repr((id(self.mesh), self.pose_number, self.surface)).encode()


class GpuMesh:
    """Vertex buffers and textures of one mesh. `programs`: all that draw meshes, by name."""

    def __init__(self, context: Context, programs: Mapping[str, moderngl.Program], mesh: Mesh) -> None:
        self.mesh = mesh
        self._textures: dict[tuple[int, str], moderngl.Texture] = {}
        self.parts = [GpuPart(context, programs, primitive, self._part_textures(context, primitive.surface))
                      for primitive in mesh.primitives]

    def _part_textures(self, context: Context, surface: Surface) -> dict[Slot, moderngl.Texture]:
        found: dict[Slot, moderngl.Texture] = {}
        for slot in SLOTS:
            image: Texture | None = getattr(surface, f"{slot}_texture")
            if image is None:
                continue
            mapping = surface.mappings.get(slot)
            kind = repr((slot in _IN_SRGB, mapping and mapping.wrap, mapping and mapping.nearest))
            if (id(image), kind) not in self._textures:
                self._textures[id(image), kind] = _material_texture(context, image, surface, slot)
            found[slot] = self._textures[id(image), kind]
        return found

    def take_pose(self, pose: Pose | None) -> None:
        """Move the vertices; nothing is copied for parts that stay as they are."""
        for index, part in enumerate(self.parts):
            rest = self.mesh.primitives[index]
            part.move(Posed(rest.positions, rest.normals, rest.tangents) if pose is None else pose.primitives[index])

    def release(self) -> None:
        release_all(*self.parts, *self._textures.values())


class GpuPart:
    """One primitive: `vertex_arrays` by the name of the program."""

    def __init__(self, context: Context, programs: Mapping[str, moderngl.Program], primitive: Primitive,
                 textures: dict[Slot, moderngl.Texture]) -> None:
        gl = context.gl
        self.surface = primitive.surface
        self.textures = textures
        self.has_colors = primitive.colors is not None
        self.roughnesses = _roughnesses(primitive.surface)
        count = len(primitive.positions)
        still: list[NDArray[np.floating]] = [
            np.ones((count, 2)), primitive.uvs, primitive.uvs if primitive.uvs2 is None else primitive.uvs2,
            np.ones((count, 4)) if primitive.colors is None else primitive.colors]
        self._posed = Posed(primitive.positions, primitive.normals, primitive.tangents)
        self._moving = gl.buffer(_interleaved(self._posed))
        self._still_values = np.concatenate(still, axis=1).astype("f4")
        self._still = gl.buffer(self._still_values.tobytes())
        self._indices = gl.buffer(primitive.triangles.astype("i4").tobytes())
        self.vertex_arrays = {name: self._vertex_array(gl, program) for name, program in programs.items()}

    def _vertex_array(self, gl: moderngl.Context, program: moderngl.Program) -> moderngl.VertexArray:
        content = []
        for buffer, layout in ((self._moving, _MOVING), (self._still, _STILL)):
            used = [name for name, _ in layout if name in program]
            if used:
                formats = " ".join(f"{n}f" if name in program else f"{4 * n}x" for name, n in layout)
                content.append((buffer, formats, *used))
        return gl.vertex_array(program, content, index_buffer=self._indices, index_element_size=4)

    def move(self, posed: Posed) -> None:
        """Take other positions, normals and tangents."""
        if posed.positions is not self._posed.positions:
            self._posed = posed
            self._moving.write(_interleaved(posed))

    @property
    def openness(self) -> NDArray[np.float32]:
        """(n, 2) share of the light around that reaches each vertex past the mesh itself, in front and behind."""
        return self._still_values[:, :2]

    def set_openness(self, values: NDArray[np.float32]) -> None:
        """Take other values of `openness`."""
        self._still_values[:, :2] = values
        self._still.write(self._still_values.tobytes())

    @property
    def is_detailed(self) -> bool:
        s = self.surface
        return bool(self.textures) or s.alpha_mode != "opaque" or s.alpha_cutoff is not None or self.has_colors or s.unlit

    def release(self) -> None:
        release_all(*self.vertex_arrays.values(), self._moving, self._still, self._indices)


def _roughnesses(surface: Surface) -> tuple[float, ...]:
    texture = surface.metallic_roughness_texture
    if texture is None:
        return (surface.roughness,)
    return tuple(np.percentile(texture[..., 1], ROUGHNESS_PERCENTILES) / 255.0 * surface.roughness)


def _interleaved(posed: Posed) -> bytes:
    count = len(posed.positions)
    tangents = np.broadcast_to(np.array(_NO_TANGENT), (count, 4)) if posed.tangents is None else posed.tangents
    return np.concatenate([posed.positions, posed.normals, tangents], axis=1).astype("f4").tobytes()


def _material_texture(context: Context, image: Texture, surface: Surface, slot: Slot) -> moderngl.Texture:
    size, data = (image.shape[1], image.shape[0]), np.ascontiguousarray(image).tobytes()
    # the driver then filters and reduces light, not codes
    texture = (context.gl.texture(size, 4, data, internal_format=SRGB8_ALPHA8) if slot in _IN_SRGB
               else context.gl.texture(size, 4, data))
    texture.build_mipmaps()
    mapping = surface.mappings.get(slot)
    texture.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)
    if mapping is not None:
        texture.repeat_x, texture.repeat_y = (wrap == "repeat" for wrap in mapping.wrap)
        if mapping.nearest:
            texture.filter = (moderngl.NEAREST_MIPMAP_NEAREST, moderngl.NEAREST)
    return texture

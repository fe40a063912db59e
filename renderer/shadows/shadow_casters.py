"""What casts shadows on the ground, as one mesh of proxies in the world, drawn once for each sample of a light."""

from __future__ import annotations

from collections.abc import Sequence

import moderngl
import numpy as np

from renderer.gl import GL_CLIP_DISTANCE0, Context, release_all, set_uniforms
from renderer.light.detection import Light
from renderer.models.gpu_mesh import PlacedMesh
from renderer.models.proxy import Points, Triangles
from renderer.models.shapes import Solid
from renderer.shadows.shadow_atlas import Rect

MAX_SAMPLES = 128          # as in shadow.vert.glsl


class RealThings:
    """Things whose own shadows are in the frame: what they hide already is hidden by no object."""

    def __init__(self, things: Sequence[tuple[PlacedMesh, Solid]] = ()) -> None:
        self._things = list(things)

    def hiding(self, light: Light | None) -> list[PlacedMesh]:
        """Those that hide a light, or of the residual (None) something. One that the camera sees a light in front of is farther
        away than the light; one around the camera is what the residual comes from."""
        if light is None:
            return [placed for placed, solid in self._things if np.abs(solid.unit_from_world[:3, 3]).max() > 0.5]
        camera = np.zeros((1, 3))
        return [placed for placed, solid in self._things if not solid.hides(camera, light.direction[None]).any()]


class CasterMesh:
    """Owns the buffers of the meshes that are drawn, for one program."""

    def __init__(self, context: Context, program: moderngl.Program) -> None:
        self._gl, self._program = context.gl, program
        self._vertices = context.gl.buffer(reserve=1 << 14)
        self._indices = context.gl.buffer(reserve=1 << 14)
        self._array: moderngl.VertexArray | None = None

    def draw(self, casters: list[PlacedMesh], real: list[PlacedMesh], *, fine: bool, ground: tuple[Rect, float],
             samples: tuple[np.ndarray, float]) -> None:
        """Add up, in the viewport that shows `ground` (rectangle, height), the samples (directions, weight of each) that casters
        hide and `real` things do not. Each sample has a depth of its own and what is drawn first takes it, so a sample counts once
        however many hide it."""
        count = self._write(real, casters, fine)
        (x0, z0, x1, z1), y = ground
        directions, weight = samples
        set_uniforms(self._program, {
            "ground_rect": (x0, z0, 1 / (x1 - x0), 1 / (z1 - z0)), "ground_y": y, "weight": weight,
            "sample_direction": np.pad(directions, ((0, MAX_SAMPLES - len(directions)), (0, 0))), "sample_count": len(directions)})
        gl = self._gl
        gl.enable_only(moderngl.DEPTH_TEST | moderngl.BLEND)
        gl.enable_direct(GL_CLIP_DISTANCE0)
        gl.depth_func = "<"
        gl.blend_func = moderngl.ONE, moderngl.ONE
        assert self._array is not None
        self._array.render(vertices=count, instances=len(directions))
        gl.disable_direct(GL_CLIP_DISTANCE0)
        gl.enable_only(moderngl.NOTHING)

    def _write(self, real: list[PlacedMesh], casters: list[PlacedMesh], fine: bool) -> int:
        """Returns the number of indices."""
        points, triangles, first = [], [], 0
        for placed, counts in [*((item, 0.0) for item in real), *((item, 1.0) for item in casters)]:
            corners, faces = proxy(placed, fine=fine and counts > 0)
            points.append(np.column_stack([corners, np.full(len(corners), counts)]))
            triangles.append(faces + first)
            first += len(corners)
        vertices, indices = np.concatenate(points).astype("f4").tobytes(), np.concatenate(triangles).astype("i4")
        if self._array is None or self._vertices.size < len(vertices) or self._indices.size < indices.nbytes:
            release_all(self._array)
            self._vertices.orphan(max(self._vertices.size, 2 * len(vertices)))
            self._indices.orphan(max(self._indices.size, 2 * indices.nbytes))
            self._array = self._gl.vertex_array(self._program, [(self._vertices, "3f 1f", "position", "counts")],
                                                index_buffer=self._indices, index_element_size=4)
        self._vertices.write(vertices)
        self._indices.write(indices.tobytes())
        return int(indices.size)

    def release(self) -> None:
        release_all(self._array, self._vertices, self._indices)


def proxy(placed: PlacedMesh, *, fine: bool) -> tuple[Points, Triangles]:
    """An object's (n, 3) points in the world and its triangles: at most 500 of them, or 128."""
    mesh = placed.mesh.mesh
    points, triangles = mesh.fine_proxy if fine else mesh.proxy
    if placed.pose is not None:
        points = mesh.posed_proxy(placed.pose, fine)
    matrix = placed.world_from_model
    return np.asarray(points @ matrix[:3, :3].T + matrix[:3, 3], dtype=np.float32), triangles

"""Shadows on the ground as MR360 casts them (section 6.3): a depth map along each light, percentage-closer filtered.

The baseline of `light_shadows.py`, into the same maps of the ground. The paper sets two parameters of UE4 by the light's solid
angle Omega, clamped to [0.1, 0.6] sr and mapped linearly: the dynamic shadow distance to D in [40, 200] m, and the distribution
exponent of its two cascades to e in [1, 3]. A larger D spreads the texels of the map, and so the penumbra. What that comes to in
metres it does not say; this is our reading of it, by UE4's own rules and default quality:

* a cascade is the square around the sphere about the camera that ends at its distance: the first at D / (1 + e), the second at D
  (UE4 splits by a geometric series of ratio e); an object belongs to the first whose distance reaches it. UE4 has no shadows beyond
  the second; here it goes on, so that none is missing.
* 2048 texels a side and a filter of 5 x 5 texels, bilinear: a penumbra, across the light, of 5 * 2 * distance / 2048: 9.8 cm for
  a small light, 24 cm for a large one near the camera, whatever the distance of what casts the shadow.
* of the constant and slope-scaled bias a millimetre is left: on a plane below all casters there is nothing for them to mend.

Left out, for it is not given: the lower intensity of larger lights. Each object has a map of its own, clamped together where they
overlap. The paper's contact shadows are UE4's ambient occlusion in screen space: `screen_space_occlusion`. Objects are shadowed by
`light_visibility.py` with either method.
"""

from __future__ import annotations

import moderngl
import numpy as np
from numpy.typing import NDArray

from renderer.gl import Context, release_all, set_uniforms
from renderer.light.detection import Light
from renderer.light.irradiance import irradiance
from renderer.models.gpu_mesh import PlacedMesh
from renderer.objects.placement import looking_along
from renderer.objects.surfaces import SurfaceStage

Array = NDArray[np.float64]
SOLID_ANGLES_SR = (0.1, 0.6)
DISTANCES_M = (40.0, 200.0)
EXPONENTS = (1.0, 3.0)
RESOLUTION = 2048          # texels a side of a cascade
FILTER = 5                 # texels a side; as in pcf_shadow.frag.glsl
SIZE = 1024                # texels a side of the depth map, which holds one object; a larger one is drawn coarser
BORDER = 3                 # empty texels around it
BIAS_M = 1e-3
OCCLUSION = 0.5            # UE4's default intensity of ambient occlusion
FIRST_UNIT = 8             # texture units after the panorama's


def texel_size(solid_angle: float, distance: float) -> float:
    """Metres that a texel is wide for a light of `solid_angle` sr and an object `distance` metres from the camera."""
    far = float(np.interp(solid_angle, SOLID_ANGLES_SR, DISTANCES_M))
    near = far / (1 + float(np.interp(solid_angle, SOLID_ANGLES_SR, EXPONENTS)))
    return 2 * (near if distance <= near else far) / RESOLUTION


def screen_space_occlusion(coefficients: Array) -> Array:
    """(9, 3) coefficients that stand in for the residual's, (9 or more, 3), where the ground's ambient light is occluded.

    UE4's occlusion knows no directions of light: the share of the cosine-weighted upper hemisphere that objects cover, at its
    default intensity, times the ambient irradiance. Here the coverage itself is exact, not of the screen, so that it does not
    depend on the view and no handicap is given to the paper.
    """
    uniform = np.zeros((9, 3))
    up = np.array([0.0, 1.0, 0.0])
    uniform[0] = OCCLUSION * np.maximum(irradiance(coefficients, up), 0.0) / np.pi * np.sqrt(4 * np.pi)
    return uniform


class ShadowMapping:
    """Owns the depth map, for one object and light at a time, and the program that looks it up."""

    def __init__(self, context: Context, surfaces: SurfaceStage) -> None:
        gl = self._gl = context.gl
        self._surfaces = surfaces
        self._depth = gl.depth_texture((SIZE, SIZE))
        self._depth.compare_func = ""
        self._depth.filter = (moderngl.NEAREST, moderngl.NEAREST)
        self._framebuffer = gl.framebuffer([], self._depth)
        self._program = context.program("full_screen.vert.glsl", "pcf_shadow.frag.glsl")
        self._triangle = gl.vertex_array(self._program, [])

    def fill(self, target: moderngl.Framebuffer, viewport: tuple[int, int, int, int], rect: tuple[float, float, float, float],
             ground_y: float, placed: PlacedMesh, points: Array, light: Light) -> None:
        """Add the share of the light that the object hides to a part of `target` that shows the ground's `rect` (x0, z0, x1, z1
        in metres). `points`: (n, 3) outline of the object in the world."""
        rotation = looking_along(-light.direction)
        texel = _texel(points, rotation, light)
        seen = points @ rotation.T
        low, high = seen.min(axis=0), seen.max(axis=0)
        size = np.minimum(np.ceil((high - low)[:2] / texel).astype(int) + 2 * BORDER, SIZE)
        low -= [BORDER * texel, BORDER * texel, 0.01]
        extent = np.array([*(size * texel), float(_depth_of(rect, ground_y, rotation, high[2])) - low[2] + 0.01])
        clip_from_world = np.eye(4)
        clip_from_world[:3, :3] = rotation * (2 / extent)[:, None]
        clip_from_world[:3, 3] = -2 * low / extent - 1
        drawn = (0, 0, int(size[0]), int(size[1]))
        self._framebuffer.use()
        self._framebuffer.viewport = drawn
        self._framebuffer.clear(depth=1.0, viewport=drawn)
        self._surfaces.draw_depth(clip_from_world, [placed])
        target.use()
        target.viewport = viewport
        self._depth.use(FIRST_UNIT)
        set_uniforms(self._program, {
            "depth_map": FIRST_UNIT, "clip_from_world": clip_from_world.T, "map_size": drawn[2:], "bias": BIAS_M / extent[2],
            "ground_rect": (*rect[:2], rect[2] - rect[0], rect[3] - rect[1]), "ground_y": ground_y, "cell": viewport})
        self._gl.enable_only(moderngl.BLEND)
        self._gl.blend_func = moderngl.ONE, moderngl.ONE
        self._triangle.render(moderngl.TRIANGLES, 3)
        self._gl.enable_only(moderngl.NOTHING)

    def release(self) -> None:
        release_all(self._framebuffer, self._depth, self._triangle, self._program)


def filter_reach(points: Array, light: Light) -> tuple[float, float]:
    """How far in x and z the filter spreads the shadow of an object on the ground, in metres. `points`: (n, 3) outline."""
    rotation = looking_along(-light.direction)
    half = (FILTER + 1) / 2 * _texel(points, rotation, light)
    corners = half * (rotation[0] + np.array([[1.0], [-1.0]]) * rotation[1])
    on_ground = np.abs(corners - light.direction * (corners[:, 1:2] / light.direction[1])).max(axis=0)
    return float(on_ground[0]), float(on_ground[2])


def _texel(points: Array, rotation: Array, light: Light) -> float:
    """In metres; as the paper has it unless the object then does not fit into the depth map."""
    wanted = texel_size(light.solid_angle, float(np.linalg.norm(points.mean(axis=0))))
    return max(wanted, float(np.ptp(points @ rotation[:2].T, axis=0).max()) / (SIZE - 2 * BORDER - 1))


def _depth_of(rect: tuple[float, float, float, float], ground_y: float, rotation: Array, least: float) -> float:
    """Depth along the light of the farthest point of a ground rectangle, at least `least`."""
    x0, z0, x1, z1 = rect
    corners = np.array([[x, ground_y, z] for x in (x0, x1) for z in (z0, z1)])
    return max(float((corners @ rotation[2]).max()), least)

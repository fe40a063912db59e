"""Shadows on the ground plane: area lights as many projected hard shadows, the residual's occlusion as a transfer vector.

No shadow map in the usual sense: proxies are projected onto the plane along each sample direction of a light and counted
(Heckbert & Herf 1997), so there is no bias to tune, contact is exact and the penumbra follows from the light's size. What the
objects hide of the residual depends on geometry alone, so it is kept until an object moves and costs one dot product a frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

import moderngl
import numpy as np
from numpy.typing import NDArray

from renderer.equirectangular import uv_from_direction
from renderer.gl import GL_CLIP_DISTANCE0, Context, release_all, set_uniforms
from renderer.gpu_mesh import GpuMesh, PlacedMesh
from renderer.light_detection import Light
from renderer.light_discs import STALE_SHARE, disc_directions, hardly_moved
from renderer.proxy import Points, Triangles
from renderer.shadow_mapping import ShadowMapping, filter_reach
from renderer.shapes import Solid
from renderer.surfaces import SurfaceStage

Array = NDArray[np.float64]
LIGHT, AMBIENT, FINE_LIGHT = 0, 1, 2     # proxies, each with the program it is drawn by
CELL = 256                 # texels a side of one light's shadow map, at most
AMBIENT_CELL = 64
GRID = 8                   # cells a side of either atlas
MAX_SAMPLES = 32           # of a light's disc
MAX_MOVING_SAMPLES = 10    # the same, and texels a side, of a shadow that has just moved
MOVING_TEXELS = 128
MOVING_SHARP = 4
SETTLED_FRAMES = 8         # that a shadow holds before it is drawn finely again
SHARP = 12                  # texels; a narrower penumbra shows the corners of a coarse proxy
AMBIENT_SAMPLES = 96
FIRST_UNIT = 8            # texture units after the panorama's
MIN_ELEVATION = np.sin(np.radians(3.0))   # of a sample; flatter ones would cast without end
MAX_REACH_M = 40.0
_PADDING = 0.02     # of a rectangle, so that no shadow touches its edge


@dataclass(frozen=True)
class ShadowMap:
    """Cell of the atlas, ground rectangle (x0, z0, x1, z1) in metres, index of the light (-1: the residual), and how many
    texels a side of the cell are in use."""

    cell: int
    rect: tuple[float, float, float, float]
    light: int
    texels: int = CELL

    def scaled_rect(self) -> tuple[float, float, float, float]:
        x0, z0, x1, z1 = self.rect
        return (x0, z0, 1 / (x1 - x0), 1 / (z1 - z0))

    def cell_uv(self) -> tuple[float, float, float]:
        share = (1.0 if self.light < 0 else self.texels / CELL) / GRID
        return (self.cell % GRID / GRID, self.cell // GRID / GRID, share)

    def outline(self, ground_y: float) -> Array:
        """(n, 3) points on the edge of what the map covers: its rectangle, or for the residual the ellipse in it."""
        x0, z0, x1, z1 = self.rect
        if self.light < 0:
            angle = np.linspace(0, 2 * np.pi, 65)
            x, z = (x0 + x1) / 2 + (x1 - x0) / 2 * np.cos(angle), (z0 + z1) / 2 + (z1 - z0) / 2 * np.sin(angle)
            return np.stack([x, np.full_like(x, ground_y), z], axis=1)
        t = np.linspace(0, 1, 17)
        x = np.concatenate([x0 + (x1 - x0) * t, x0 + (x1 - x0) * t, np.full(17, x0), np.full(17, x1)])
        z = np.concatenate([np.full(17, z0), np.full(17, z1), z0 + (z1 - z0) * t, z0 + (z1 - z0) * t])
        return np.stack([x, np.full_like(x, ground_y), z], axis=1)


def _hemisphere_directions(count: int) -> Array:
    """(count, 3) cosine-distributed directions of the upper hemisphere; each stands for pi / count of irradiance."""
    index = np.arange(count)
    radius = np.sqrt((index + 0.5) / count)
    phi = index * np.pi * (3 - np.sqrt(5))
    return np.stack([radius * np.cos(phi), np.sqrt(1 - radius**2), radius * np.sin(phi)], axis=1)


@dataclass
class _KeptShadow:
    cell: int
    place: bytes
    light: Light
    shadow: ShadowMap | None
    is_fine: bool
    frames: int = 0     # that it has held


@dataclass
class _Proxies:
    """What casts one mesh's shadows, by the kind of shadow, in the pose of that number."""

    points: list[moderngl.Buffer]
    triangles: list[moderngl.Buffer]
    arrays: list[moderngl.VertexArray]
    pose_number: int

    def add(self, gl: moderngl.Context, program: moderngl.Program, points: Points, triangles: Triangles) -> None:
        self.points.append(gl.buffer(points.astype("f4").tobytes()))
        self.triangles.append(gl.buffer(triangles.astype("i4").tobytes()))
        self.arrays.append(gl.vertex_array(program, [(self.points[-1], "3f", "position")], index_buffer=self.triangles[-1],
                                           index_element_size=4))


class ShadowStage:
    """Owns the shadow programs and both atlases."""

    def __init__(self, context: Context, frame_size: tuple[int, int], surfaces: SurfaceStage) -> None:
        gl = self._gl = context.gl
        self._context, self._surfaces = context, surfaces
        self._mapping: ShadowMapping | None = None      # made when it is first wanted
        self._frame_size = frame_size
        self._light_program = context.program("shadow.vert.glsl", "shadow.frag.glsl")
        self._ambient_program = context.program("shadow.vert.glsl", "ambient_shadow.frag.glsl")
        size, ambient_size = (GRID * CELL,) * 2, (GRID * AMBIENT_CELL,) * 2
        self.atlas = context.texture(size, 1, "f2")
        self.transfer = [context.texture(ambient_size, 4, "f2") for _ in range(3)]
        self.ambient_atlas = context.texture(ambient_size, 4, "f2")
        self._missing_program = context.program("full_screen.vert.glsl", "ambient_missing.frag.glsl")
        self._missing_triangle = gl.vertex_array(self._missing_program, [])
        self._missing_target = gl.framebuffer([self.ambient_atlas])
        self._depth = [gl.depth_renderbuffer(size), gl.depth_renderbuffer(ambient_size)]
        self._target = gl.framebuffer([self.atlas], self._depth[0])
        self._ambient_target = gl.framebuffer(self.transfer, self._depth[1])
        self._proxies: WeakKeyDictionary[GpuMesh, _Proxies] = WeakKeyDictionary()
        self._ambient: dict[str, tuple[bytes, ShadowMap]] = {}
        self._lights: dict[tuple[str, int], _KeptShadow] = {}
        self._weighed: tuple[list[ShadowMap], bytes] | None = None
        self._redrawn = 0
        self._real: list[tuple[PlacedMesh, Solid]] = []
        upper = _hemisphere_directions(AMBIENT_SAMPLES)
        set_uniforms(self._ambient_program, {"sample_direction": np.pad(upper, ((0, 128 - AMBIENT_SAMPLES), (0, 0))),
                                             "sample_count": AMBIENT_SAMPLES})

    def light_shadow(self, key: str, placed: PlacedMesh, light: Light, light_index: int, ground_y: float, *,
                     filtered: bool = False) -> ShadowMap | None:
        """One object's shadow from one light, drawn unless the last one still holds. None when there is nothing to see. `filtered`:
        by the papers' method, `shadow_mapping.py`.

        It holds while object and ground are as they were and the light has moved by less than a quarter of its radius:
        the shadow's edge then errs by less than an eighth of its penumbra. Up to a whole radius it waits for its turn, one
        map a frame, so that a moving sun does not have all shadows drawn in the same frame. What is drawn anew is drawn coarser
        than at first, and finely again when nothing has moved for a while.
        """
        place = _place_state([placed, *self._hiding(light)], ground_y) + bytes([filtered])
        kept = self._lights.get((key, light.id))
        if kept is not None and kept.place == place:
            tolerance = STALE_SHARE if self._redrawn == 0 else 1.0
            if hardly_moved(kept.light, light, tolerance):
                kept.frames += 1
                if kept.is_fine or kept.frames < SETTLED_FRAMES or self._redrawn > 0:
                    return replace(kept.shadow, light=light_index) if kept.shadow is not None else None
            self._redrawn += 1
        cell = kept.cell if kept is not None else self._free_cell()
        if cell is None:
            return None
        fresh = ShadowMap(cell, (0, 0, 0, 0), light_index)
        is_fine = kept is None or (kept.place == place and kept.frames >= SETTLED_FRAMES)
        shadow = (self._draw_filtered_shadow(placed, light, fresh, ground_y) if filtered
                  else self._draw_light_shadow(placed, light, fresh, ground_y, is_fine=is_fine))
        self._lights[(key, light.id)] = _KeptShadow(cell, place, light, shadow, is_fine or filtered)
        return shadow

    def _free_cell(self) -> int | None:
        used = {kept.cell for kept in self._lights.values()}
        return next((cell for cell in range(GRID * GRID) if cell not in used), None)

    def _draw_light_shadow(self, placed: PlacedMesh, light: Light, shadow: ShadowMap, ground_y: float, *,
                           is_fine: bool) -> ShadowMap | None:
        points = placed.outline()
        height = float(points[:, 1].max()) - ground_y
        rim = np.concatenate([[light.direction], disc_directions(light.direction, light.angular_radius, 12)])
        rim = rim[rim[:, 1] > MIN_ELEVATION]
        if height <= 0.0 or not len(rim):
            return None
        rect = _ground_rect(points, rim, ground_y)
        texels = min(self._texels(rect, ground_y), CELL if is_fine else MOVING_TEXELS)
        texel = max(rect[2] - rect[0], rect[3] - rect[1]) / texels
        elevation = max(float(light.direction[1]), 0.05)
        penumbra = 2 * light.angular_radius * height / elevation**2
        most = MAX_SAMPLES if is_fine else MAX_MOVING_SAMPLES
        count = 1 if penumbra < 2 * texel else int(np.clip(2 * penumbra / texel, 6, most))
        samples = disc_directions(light.direction, light.angular_radius, count) if count > 1 else light.direction[None]
        samples = samples[samples[:, 1] > MIN_ELEVATION]
        if not len(samples):
            return None
        shadow = replace(shadow, rect=rect, texels=texels)
        set_uniforms(self._light_program, {
            "sample_direction": np.pad(samples, ((0, 128 - len(samples)), (0, 0))), "sample_count": len(samples)})
        proxy = FINE_LIGHT if penumbra < (SHARP if is_fine else MOVING_SHARP) * texel else LIGHT
        self._draw(self._target, self._light_program, proxy, [*self._hiding(light), placed], shadow, ground_y,
                   (len(samples), 1.0 / count))
        return shadow

    def _draw_filtered_shadow(self, placed: PlacedMesh, light: Light, shadow: ShadowMap, ground_y: float) -> ShadowMap | None:
        points = placed.outline()
        if float(points[:, 1].max()) <= ground_y or light.direction[1] <= MIN_ELEVATION:
            return None
        if self._mapping is None:
            self._mapping = ShadowMapping(self._context, self._surfaces)
        x0, z0, x1, z1 = _ground_rect(points, light.direction[None], ground_y)
        x, z = filter_reach(points, light)
        rect = (x0 - x, z0 - z, x1 + x, z1 + z)
        shadow = replace(shadow, rect=rect, texels=self._texels(rect, ground_y))
        self._mapping.fill(self._target, self._viewport(self._target, shadow), rect, ground_y, placed, points, light)
        return shadow

    def ambient_shadow(self, key: str, placed: PlacedMesh, ground_y: float) -> ShadowMap | None:
        """What one object hides of the residual; drawn only when `key`'s geometry has changed."""
        state = _place_state([placed, *self._hiding(None)], ground_y)
        kept = self._ambient.get(key)
        if kept is not None and kept[0] == state:
            return kept[1]
        cells = {entry[1].cell for entry in self._ambient.values()}
        cell = kept[1].cell if kept else next((c for c in range(GRID * GRID) if c not in cells), None)
        points = placed.outline()
        if cell is None or float(points[:, 1].max()) <= ground_y:
            self._ambient.pop(key, None)
            return None
        low, high = points.min(axis=0), points.max(axis=0)
        reach = 0.9 * max(high[1] - ground_y, 0.3 * float(np.linalg.norm(high - low)))
        shadow = ShadowMap(cell, (float(low[0] - reach), float(low[2] - reach), float(high[0] + reach),
                                  float(high[2] + reach)), -1)
        self._ambient[key] = (state, shadow)
        self._weighed = None
        self._draw(self._ambient_target, self._ambient_program, AMBIENT, [*self._hiding(None), placed], shadow, ground_y,
                   (AMBIENT_SAMPLES, np.pi / AMBIENT_SAMPLES))
        return shadow

    def _texels(self, rect: tuple[float, float, float, float], ground_y: float) -> int:
        """Texels a side for a map that is about as fine as the frame's pixels that show it."""
        uv = uv_from_direction(ShadowMap(0, rect, 0).outline(ground_y))
        across = (uv[:, 0] - uv[0, 0] + 0.5) % 1.0
        pixels = max(np.ptp(across) * self._frame_size[0], np.ptp(uv[:, 1]) * self._frame_size[1])
        return int(np.clip(np.ceil(pixels / 16) * 16, 48, CELL))

    def weigh_ambient(self, shadows: list[ShadowMap], hidden: list[Array]) -> None:
        """Turn the maps' transfer vectors into missing irradiance. `hidden`: for each map (9, 3) coefficients of the radiance that
        the object hides in this frame, less what it gives off itself; what is missing may be negative."""
        state = b"".join(one.tobytes() for one in hidden)
        if self._weighed == (shadows, state):
            return
        self._weighed = (shadows, state)
        self._missing_target.use()
        for unit, texture in enumerate(self.transfer):
            texture.use(FIRST_UNIT + unit)
            set_uniforms(self._missing_program, {f"transfer_{unit}": FIRST_UNIT + unit})
        for shadow, coefficients in zip(shadows, hidden, strict=True):
            viewport = (shadow.cell % GRID * AMBIENT_CELL, shadow.cell // GRID * AMBIENT_CELL, AMBIENT_CELL, AMBIENT_CELL)
            self._missing_target.viewport = viewport
            set_uniforms(self._missing_program, {"cell": viewport, "hidden_sh": coefficients})
            self._missing_triangle.render(moderngl.TRIANGLES, 3)

    def reset(self) -> None:
        """Forget the lights: the next ones have nothing to do with them."""
        self._lights.clear()

    def begin(self, keys: set[str], lights: set[int], real: Sequence[tuple[PlacedMesh, Solid]] = ()) -> None:
        """Begin a frame. Free the cells of objects and lights that are gone: all but those of `keys` and `lights` (ids). `real`:
        things, also as solids, whose own shadows are in the frame: what they hide already is hidden by no object."""
        self._real = list(real)
        self._lights = {name: kept for name, kept in self._lights.items() if name[0] in keys and name[1] in lights}
        self._redrawn = 0
        for key in set(self._ambient) - keys:
            del self._ambient[key]

    def _hiding(self, light: Light | None) -> list[PlacedMesh]:
        """The real things that hide a light, or of the residual (None) something. One that the camera sees a light in front of is
        farther away than the light; one around the camera is what the residual comes from."""
        camera = np.zeros((1, 3))
        if light is None:
            return [placed for placed, solid in self._real if np.abs(solid.unit_from_world[:3, 3]).max() > 0.5]
        return [placed for placed, solid in self._real if not solid.hides(camera, light.direction[None]).any()]

    def _draw(self, target: moderngl.Framebuffer, program: moderngl.Program, which: int, placed: list[PlacedMesh],
              shadow: ShadowMap, ground_y: float, samples: tuple[int, float]) -> None:
        """Count the samples, `samples` of that weight, that the last mesh hides and those before it do not."""
        gl = self._gl
        viewport = self._viewport(target, shadow)
        target.use()
        target.viewport = viewport
        target.clear(0.0, 0.0, 0.0, 0.0, depth=1.0, viewport=viewport)
        gl.enable_only(moderngl.DEPTH_TEST | moderngl.BLEND)
        gl.enable_direct(GL_CLIP_DISTANCE0)
        gl.depth_func = "<"      # a sample has one depth, and what is drawn first takes it
        gl.blend_func = moderngl.ONE, moderngl.ONE
        set_uniforms(program, {"ground_rect": shadow.scaled_rect(), "ground_y": ground_y})
        # sample by sample where things stand in each other's way, for a later sample is nearer than all before it
        for first, count in [(0, samples[0])] if len(placed) == 1 else [(index, 1) for index in range(samples[0])]:
            for item in placed:
                set_uniforms(program, {"world_from_model": item.world_from_model.T, "first_sample": first,
                                       "weight": samples[1] if item is placed[-1] else 0.0})
                self._proxy(item)[which].render(instances=count)
        gl.disable_direct(GL_CLIP_DISTANCE0)
        gl.enable_only(moderngl.NOTHING)

    @staticmethod
    def _viewport(target: moderngl.Framebuffer, shadow: ShadowMap) -> tuple[int, int, int, int]:
        cell = target.width // GRID
        used = cell if shadow.light < 0 else shadow.texels
        return (shadow.cell % GRID * cell, shadow.cell // GRID * cell, used, used)

    def _proxy(self, placed: PlacedMesh) -> list[moderngl.VertexArray]:
        mesh = placed.mesh.mesh
        if placed.mesh not in self._proxies:
            proxies = (self._light_program, mesh.proxy), (self._ambient_program, mesh.proxy), (self._light_program, mesh.fine_proxy)
            self._proxies[placed.mesh] = _Proxies([], [], [], 0)
            for program, (points, triangles) in proxies:
                self._proxies[placed.mesh].add(self._gl, program, points, triangles)
        kept = self._proxies[placed.mesh]
        if placed.pose is not None and kept.pose_number != placed.pose_number:
            kept.pose_number = placed.pose_number
            for buffer, fine in zip(kept.points, (False, False, True), strict=True):
                buffer.write(mesh.posed_proxy(placed.pose, fine).astype("f4"))
        return kept.arrays

    def release(self) -> None:
        for kept in self._proxies.values():
            release_all(*kept.arrays, *kept.points, *kept.triangles)
        release_all(self._missing_target, self._missing_triangle, self._missing_program, self.ambient_atlas)
        release_all(self._target, self._ambient_target, self.atlas, *self.transfer, *self._depth, self._light_program,
                    self._ambient_program, self._mapping)


def _place_state(placed: list[PlacedMesh], ground_y: float) -> bytes:
    return b"".join(item.state() for item in placed) + np.float64(ground_y).tobytes()


def _ground_rect(points: Array, directions: Array, ground_y: float) -> tuple[float, float, float, float]:
    above = points[points[:, 1] > ground_y]
    heights = (above[:, 1] - ground_y)[:, None]
    offset_x, offset_z = (heights * (directions[:, axis] / directions[:, 1])[None, :] for axis in (0, 2))
    x, z = above[:, :1] - offset_x, above[:, 2:] - offset_z
    centre = above.mean(axis=0)
    low = [max(float(v.min()), float(c) - MAX_REACH_M) for v, c in ((x, centre[0]), (z, centre[2]))]
    high = [min(float(v.max()), float(c) + MAX_REACH_M) for v, c in ((x, centre[0]), (z, centre[2]))]
    pad = [max((b - a) * _PADDING, 1e-3) for a, b in zip(low, high, strict=True)]
    return (low[0] - pad[0], low[1] - pad[1], high[0] + pad[0], high[1] + pad[1])

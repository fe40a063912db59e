"""The renderer: one frame and one scene in, the composited frame and its lights out."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from renderer.color import srgb_from_linear
from renderer.composite import CompositeStage, DrawView, GroundLight, Touched
from renderer.frame import Frame, RadianceFrame, RgbFrame, YuvFrame, check_size
from renderer.gl import Context, release_all
from renderer.gltf import GltfError, transform
from renderer.inverse_tone_mapping import WEIGHTS, linear_from_radiance
from renderer.irradiance import disc_cosine, irradiance, project
from renderer.light_detection import Detection, find_candidates
from renderer.light_tracking import LightTracker
from renderer.mesh import Surface
from renderer.mesh_library import MeshLibrary
from renderer.objects import MIRROR_BELOW, GpuMesh, Illumination, ObjectStage, PlacedMesh
from renderer.panorama import PanoramaTextures
from renderer.placement import TILE, TileMask, View, plan_views, touched_tiles
from renderer.radiance_map import RadianceMapStage, packed_pixels
from renderer.scene import Scene, SceneObject
from renderer.shadows import ShadowMap, ShadowStage, world_points
from renderer.specular import irradiance_map, prefilter_all, quantized_roughness, resample

Array = NDArray[np.float64]
UP = np.array([0.0, 1.0, 0.0])
MIN_CAMERA_DISTANCE_M = 0.05
SMALL_ROWS = 64             # of the residual for spherical harmonics and prefiltering, which use no more
MIN_GROUND_SHARE = 0.02    # of the ground's irradiance; weaker lights cast no visible shadow


@dataclass
class Timings:
    """Milliseconds of each stage of one frame."""

    stages: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.stages[name] = self.stages.get(name, 0.0) + (time.perf_counter() - start) * 1e3

    @property
    def total(self) -> float:
        return sum(self.stages.values())


@dataclass(frozen=True)
class FrameLight:
    """The light of one frame: lights and residual; the residual's (25, 3) spherical harmonics; the map that lights surfaces
    together with the lights that are not wide, small, and its irradiance by the direction of the normal."""

    detection: Detection
    coefficients: Array
    soft: NDArray[np.float32]
    irradiance: NDArray[np.float32]


@dataclass(frozen=True)
class Placement:
    """The objects that can be drawn, by id; the views that show them; what is wrong with the others."""

    objects: dict[str, PlacedMesh]
    views: list[View]
    errors: dict[str, str]


@dataclass(frozen=True)
class _Lit:
    """A placement under a light: what the ground receives, and the tiles of every shadow."""

    light: FrameLight
    placement: Placement
    ground: GroundLight | None
    maps: list[Touched]
    ambient: list[Touched]


@dataclass(frozen=True)
class Rendered:
    """The composited frame; `errors` names the objects that could not be drawn and why."""

    frame: Frame
    light: FrameLight
    touched_fraction: float
    timings: Timings
    errors: dict[str, str]


class Pipeline:
    """Renders frames of one kind and size. Owns all GL objects; use it on the context's thread only."""

    def __init__(self, context: Context, kind: type[Frame], size: tuple[int, int], *, assets: Path | None = None,
                 mesh_root: Path | None = None) -> None:
        self._context = context
        self._size = size
        self._panorama = PanoramaTextures(context, kind, size, packed_pixels(kind, size))
        self._radiance = RadianceMapStage(context, self._panorama)
        self._objects = ObjectStage(context, self._panorama, self._radiance.texture)
        self._shadows = ShadowStage(context, size)
        self._composite = CompositeStage(context, self._panorama)
        self._meshes = MeshLibrary(lambda mesh: GpuMesh(context, self._objects.surface_programs, mesh), assets, mesh_root)
        self._tracker = LightTracker()
        self._lit: _Lit | None = None
        self._shadow_tiles: dict[tuple[ShadowMap, float], TileMask] = {}
        self._last_placement: tuple[Scene, dict[str, float], Placement] | None = None

    def analyse(self, frame: Frame, moment: float | None = None) -> tuple[FrameLight, Timings]:
        """Find the light of a frame shown at `moment` seconds without compositing anything."""
        timings = Timings()
        with timings.stage("upload"):
            self._panorama.write(frame, only_packed=True)
            self._panorama.use()
        return self._light(timings, moment), timings

    def render(self, frame: Frame, scene: Scene, *, light: FrameLight | None = None, moment: float | None = None,
               output: YuvFrame | None = None) -> Rendered:
        """Composite the scene into the frame. The frame's own arrays stay as they are.

        `light` is that of an earlier frame, to light this one by; without it, it is read from this one first, which is shown
        at `moment` seconds. `output` are planes to write into, for a YuvFrame; without them there are new ones.
        """
        self._context.assert_own_thread()
        check_size(frame)
        timings = Timings()
        visible = [item for item in scene.objects if item.visible]
        with timings.stage("place"):
            placement = self._placement(scene, visible)
        with timings.stage("upload"):
            self._panorama.write(frame, only_packed=not any(item.may_mirror for item in placement.objects.values()))
            self._panorama.use()
        if light is None:
            light = self._light(timings, moment)
        if not visible:
            return Rendered(frame if output is None else _copied(frame, output), light, 0.0, timings, {})
        lit = self._light_scene(scene, light, placement, timings)
        with timings.stage("objects_and_composite"):
            draw_view = self._drawing(placement)
            touched = self._composite.run(placement.views, draw_view, lit.maps, lit.ambient, lit.ground, self._shadows)
            self._context.start()   # while the planes are being copied
        with timings.stage("write"):
            composited = self._write(frame, touched, output)
        self._context.collect()
        fraction = len(touched) * TILE * TILE / (self._size[0] * self._size[1])
        return Rendered(composited, light, fraction, timings, placement.errors)

    def read_light(self, moment: float | None = None) -> tuple[FrameLight, Timings]:
        """The light of the frame that was rendered last, which is shown at `moment` seconds."""
        timings = Timings()
        return self._light(timings, moment), timings

    def prepare(self, light: FrameLight) -> Timings:
        """Do now what the next frame would need first to be lit by this light, if its scene is that of the last frame."""
        timings = Timings()
        if self._last_placement is not None and self._last_placement[2].objects:
            scene, _, placement = self._last_placement
            self._light_scene(scene, light, placement, timings)
            with timings.stage("objects_and_composite"):
                self._objects.draw_still(placement.views, list(placement.objects.values()))
                self._context.gl.finish()
        return timings

    def compile_variants(self) -> None:
        """Have the driver compile every program that usual scenes need, now. After a frame with a light and an object."""
        if self._lit is not None:
            self._objects.compile_variants(self._lit.placement.views[0])
            self._composite.compile_variants()

    def _light(self, timings: Timings, moment: float | None) -> FrameLight:
        with timings.stage("radiance_map"):
            radiance_map = self._radiance.run()
        with timings.stage("lights"):
            detection = self._tracker.update(find_candidates(radiance_map), moment)
        with timings.stage("irradiance"):
            soft = _small(detection.soft)
            residual = soft if detection.soft is detection.residual else _small(detection.residual)
            return FrameLight(detection, project(residual), soft, irradiance_map(soft))

    def _placement(self, scene: Scene, visible: list[SceneObject]) -> Placement:
        """Where the scene's objects stand; kept until the scene or a model's file changes."""
        meshes = self._meshes.state(item.mesh for item in visible)
        if self._last_placement is None or self._last_placement[0] is not scene or self._last_placement[1] != meshes:
            placed, errors = self._place(visible, scene)
            outlines = [world_points(item) for item in placed.values()]
            tiles = [touched_tiles(points, self._size) for points in outlines]
            placement = Placement(placed, plan_views(outlines, tiles, self._size), errors)
            self._last_placement = (scene, self._meshes.state(item.mesh for item in visible), placement)
        return self._last_placement[2]

    def _place(self, visible: list[SceneObject], scene: Scene) -> tuple[dict[str, PlacedMesh], dict[str, str]]:
        placed: dict[str, PlacedMesh] = {}
        errors = {item.id: f"local surface {item.id!r} is not rendered yet" for item in scene.local_scene}
        for item in visible:
            try:
                mesh = self._meshes.get(item.mesh)
            except GltfError as error:
                errors[item.id] = str(error)
                continue
            candidate = PlacedMesh(mesh, transform(item.position, item.rotation, item.scale), _surface(item, mesh))
            points = world_points(candidate)
            if _contains_camera(points):
                errors[item.id] = f"object {item.id!r} contains the camera, expected it to stay clear of the origin"
            elif scene.ground.catcher and points[:, 1].max() <= -scene.camera_height:
                errors[item.id] = f"object {item.id!r} is below the ground at y = {-scene.camera_height:g}"
            else:
                placed[item.id] = candidate
                if item.animation is not None:
                    errors[item.id] = f"animation {item.animation.clip!r} of object {item.id!r} is not played yet"
        return placed, errors

    def _light_scene(self, scene: Scene, light: FrameLight, placement: Placement, timings: Timings) -> _Lit:
        """What follows from light and placement together; kept until one of them is another."""
        if self._lit is not None and self._lit.light is light and self._lit.placement is placement:
            return self._lit
        with timings.stage("glossy"):
            self._objects.keep(placement.views)
            self._objects.set_illumination(_illumination(scene, light, list(placement.objects.values())))
        with timings.stage("shadows"):
            ground = self._ground_light(scene, light)
            maps, ambient = self._cast(scene, placement.objects, light, ground) if ground else ([], [])
        self._lit = _Lit(light, placement, ground, maps, ambient)
        return self._lit

    def _ground_light(self, scene: Scene, light: FrameLight) -> GroundLight | None:
        if not scene.ground.catcher:
            return None
        lights = [item.irradiance * float(disc_cosine(item.direction @ UP, item.angular_radius)) for item in light.detection.lights]
        ambient = np.maximum(irradiance(light.coefficients, UP), 0.0)
        return GroundLight(-scene.camera_height, ambient + sum(lights, np.zeros(3)), lights)

    def _cast(self, scene: Scene, placed: dict[str, PlacedMesh], light: FrameLight,
              ground: GroundLight) -> tuple[list[Touched], list[Touched]]:
        casters = {item.id: placed[item.id] for item in scene.objects if item.id in placed and item.casts_shadow}
        gate = MIN_GROUND_SHARE * float(ground.total @ WEIGHTS)
        self._shadows.begin(set(casters), {item.id for item in light.detection.lights})
        maps: list[ShadowMap | None] = []
        ambient: list[ShadowMap | None] = []
        for key, caster in casters.items():
            for index, item in enumerate(light.detection.lights):
                if ground.lights[index] @ WEIGHTS > gate:
                    maps.append(self._shadows.light_shadow(key, caster, item, index, ground.y))
            ambient.append(self._shadows.ambient_shadow(key, caster, ground.y))
        self._shadows.weigh_ambient([shadow for shadow in ambient if shadow is not None], light.coefficients[:9])

        touched = self._touched([shadow for shadow in (*maps, *ambient) if shadow is not None], ground.y)
        return [item for item in touched if item.shadow.light >= 0], [item for item in touched if item.shadow.light < 0]

    def _touched(self, shadows: list[ShadowMap], ground_y: float) -> list[Touched]:
        """The tiles of each map; those of a map that lies where it lay in the last frame are kept."""
        tiles = {}
        for shadow in shadows:
            kept = self._shadow_tiles.get((shadow, ground_y))
            tiles[(shadow, ground_y)] = touched_tiles(shadow.outline(ground_y), self._size) if kept is None else kept
        self._shadow_tiles = tiles
        return [Touched(shadow, tiles[(shadow, ground_y)]) for shadow in shadows]

    def _drawing(self, placement: Placement) -> DrawView:
        objects = list(placement.objects.values())
        return lambda view: self._objects.draw(view, objects)

    def _write(self, frame: Frame, tiles: NDArray[np.intp], output: YuvFrame | None) -> Frame:
        if isinstance(frame, YuvFrame):
            composited = _copied(frame, output)
            self._composite.write_yuv(composited, tiles)
            return composited
        radiance, touched = self._composite.touched_radiance(tiles, frame)
        if isinstance(frame, RadianceFrame):
            return RadianceFrame(np.where(touched[..., None], radiance, frame.rgb))
        signal = srgb_from_linear(np.clip(linear_from_radiance(radiance), 0.0, 1.0))
        return RgbFrame(np.where(touched[..., None], np.round(signal * 255).astype(np.uint8), frame.rgb))

    def reset(self) -> None:
        """Forget the lights of earlier frames."""
        self._tracker.reset()

    def release(self) -> None:
        self._context.rest()
        self._meshes.release()
        release_all(self._composite, self._shadows, self._objects, self._radiance, self._panorama)


def _copied(frame: Frame, output: YuvFrame | None) -> YuvFrame:
    assert isinstance(frame, YuvFrame)
    if output is None:
        return frame.copy()
    for target, source in ((output.y, frame.y), (output.u, frame.u), (output.v, frame.v)):
        np.copyto(target, source)
    return output


def _small(radiance: Array) -> NDArray[np.float32]:
    small = radiance.astype(np.float32)
    return resample(small, SMALL_ROWS, 2 * SMALL_ROWS) if small.shape[0] > SMALL_ROWS else small


def _illumination(scene: Scene, light: FrameLight, objects: list[PlacedMesh]) -> Illumination:
    surfaces = [surface for item in objects for surface in item.surfaces]
    wanted = {quantized_roughness(s.roughness) for s in surfaces if s.roughness >= MIRROR_BELOW}
    lights = tuple(item for item in light.detection.lights if not item.is_wide)
    return Illumination(light.irradiance, lights, prefilter_all(light.soft, wanted),
                        -scene.camera_height if scene.ground.catcher else None)


def _surface(item: SceneObject, mesh: GpuMesh) -> Surface | None:
    if item.material is None:
        return None
    r, g, b = item.material.base_color
    return Surface((r, g, b, 1.0), item.material.metallic, item.material.roughness, item.material.emissive,
                   double_sided=any(part.surface.double_sided for part in mesh.parts))


def _contains_camera(points: Array) -> bool:
    return bool((points.min(axis=0) < MIN_CAMERA_DISTANCE_M).all() and (points.max(axis=0) > -MIN_CAMERA_DISTANCE_M).all())

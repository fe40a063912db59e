"""The renderer: one frame and one scene in, the composited frame and its lights out."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import moderngl
import numpy as np
from numpy.typing import NDArray

from renderer.color import srgb_from_linear
from renderer.composite import CompositeStage, GroundLight, Touched
from renderer.frame import Frame, RadianceFrame, RgbFrame, YuvFrame, check_size
from renderer.gl import Context, release_all
from renderer.gltf import GltfError, transform
from renderer.inverse_tone_mapping import WEIGHTS, linear_from_radiance
from renderer.irradiance import irradiance, project
from renderer.light_detection import Detection, detect
from renderer.light_tracking import LightTracker
from renderer.mesh import Surface
from renderer.mesh_library import MeshLibrary
from renderer.objects import MIRROR_BELOW, GpuMesh, Illumination, ObjectStage, PlacedMesh
from renderer.panorama import PanoramaTextures
from renderer.placement import TILE, TileMask, View, plan_views, touched_tiles
from renderer.radiance_map import RadianceMapStage, packed_pixels
from renderer.scene import Scene, SceneObject
from renderer.shadows import ShadowMap, ShadowStage, world_points
from renderer.specular import prefilter_all, quantized_roughness

Array = NDArray[np.float64]
UP = np.array([0.0, 1.0, 0.0])
MIN_CAMERA_DISTANCE_M = 0.05
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
    """The light of one frame: lights and residual, and the residual's (25, 3) spherical harmonics."""

    detection: Detection
    coefficients: Array


@dataclass(frozen=True)
class Placement:
    """The objects that can be drawn, by id; the views that show them; what is wrong with the others."""

    objects: dict[str, PlacedMesh]
    views: list[View]
    errors: dict[str, str]


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
        self._last_light: FrameLight | None = None
        self._lit_by: tuple[FrameLight, Placement] | None = None
        self._shadow_tiles: dict[tuple[ShadowMap, float], TileMask] = {}
        self._last_placement: tuple[Scene, dict[str, float], Placement] | None = None

    def analyse(self, frame: Frame) -> tuple[FrameLight, Timings]:
        """Find the light of a frame without compositing anything."""
        timings = Timings()
        with timings.stage("upload"):
            self._panorama.write(frame, only_packed=True)
            self._panorama.use()
        return self._light(timings), timings

    def render(self, frame: Frame, scene: Scene, *, reuse_light: bool = False) -> Rendered:
        """Composite the scene into the frame. The frame's own arrays stay as they are.

        `reuse_light` takes the light of the last frame for this one's: the first thing to give up under load.
        """
        self._context.assert_own_thread()
        check_size(frame)
        timings = Timings()
        visible = [item for item in scene.objects if item.visible]
        with timings.stage("upload"):
            self._panorama.write(frame, only_packed=not visible)
            self._panorama.use()
        light = self._last_light if reuse_light and self._last_light is not None else self._light(timings)
        if not visible:
            return Rendered(frame, light, 0.0, timings, {})
        with timings.stage("place"):
            placement = self._placement(scene, visible)
        with timings.stage("glossy"):
            self._objects.keep(placement.views)
            if self._lit_by is None or self._lit_by[0] is not light or self._lit_by[1] is not placement:
                self._objects.set_illumination(self._illumination(scene, light, list(placement.objects.values())))
                self._lit_by = (light, placement)
        with timings.stage("shadows"):
            ground = self._ground_light(scene, light)
            maps, ambient = self._cast(scene, placement.objects, light, ground) if ground else ([], [])
        touched = self._run_composite(placement, maps, ambient, ground, timings)
        with timings.stage("write"):
            output = self._write(frame, touched)
        self._context.collect()
        fraction = len(touched) * TILE * TILE / (self._size[0] * self._size[1])
        return Rendered(output, light, fraction, timings, placement.errors)

    def _light(self, timings: Timings) -> FrameLight:
        with timings.stage("radiance_map"):
            radiance_map = self._radiance.run()
        with timings.stage("lights"):
            detection = detect(radiance_map)
            detection = Detection(self._tracker.update(detection.lights), detection.residual, detection.threshold)
        with timings.stage("irradiance"):
            self._last_light = FrameLight(detection, project(detection.residual))
        return self._last_light

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

    def _illumination(self, scene: Scene, light: FrameLight, objects: list[PlacedMesh]) -> Illumination:
        surfaces = [surface for item in objects
                    for surface in ([item.surface] if item.surface else [part.surface for part in item.mesh.parts])]
        wanted = {quantized_roughness(s.roughness) for s in surfaces if s.roughness >= MIRROR_BELOW}
        residual = light.detection.residual
        return Illumination(light.coefficients, light.detection.lights, prefilter_all(residual, wanted),
                            -scene.camera_height if scene.ground.catcher else None)

    def _ground_light(self, scene: Scene, light: FrameLight) -> GroundLight | None:
        if not scene.ground.catcher:
            return None
        lights = [item.irradiance * max(float(item.direction @ UP), 0.0) for item in light.detection.lights]
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

    def _run_composite(self, placement: Placement, maps: list[Touched], ambient: list[Touched], ground: GroundLight | None,
                       timings: Timings) -> NDArray[np.intp]:
        objects = list(placement.objects.values())

        def draw_view(view: View) -> tuple[moderngl.Texture, tuple[int, int]]:
            return self._objects.draw(view, objects)

        with timings.stage("objects_and_composite"):
            tiles = self._composite.run(placement.views, draw_view, maps, ambient, ground, self._shadows)
            self._context.gl.finish()
        return tiles

    def _write(self, frame: Frame, tiles: NDArray[np.intp]) -> Frame:
        if isinstance(frame, YuvFrame):
            output = frame.copy()
            self._composite.write_yuv(output, tiles)
            return output
        radiance, touched = self._composite.touched_radiance(tiles, frame)
        if isinstance(frame, RadianceFrame):
            return RadianceFrame(np.where(touched[..., None], radiance, frame.rgb))
        signal = srgb_from_linear(np.clip(linear_from_radiance(radiance), 0.0, 1.0))
        return RgbFrame(np.where(touched[..., None], np.round(signal * 255).astype(np.uint8), frame.rgb))

    def reset(self) -> None:
        """Forget the lights of earlier frames."""
        self._tracker = LightTracker()
        self._last_light = None

    def release(self) -> None:
        self._context.rest()
        self._meshes.release()
        release_all(self._composite, self._shadows, self._objects, self._radiance, self._panorama)


def _surface(item: SceneObject, mesh: GpuMesh) -> Surface | None:
    if item.material is None:
        return None
    r, g, b = item.material.base_color
    return Surface((r, g, b, 1.0), item.material.metallic, item.material.roughness, item.material.emissive,
                   double_sided=any(part.surface.double_sided for part in mesh.parts))


def _contains_camera(points: Array) -> bool:
    return bool((points.min(axis=0) < MIN_CAMERA_DISTANCE_M).all() and (points.max(axis=0) > -MIN_CAMERA_DISTANCE_M).all())

"""The renderer: one frame and one scene in, the composited frame and its lights out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import moderngl
import numpy as np
from numpy.typing import NDArray

from renderer.color import srgb_from_linear
from renderer.composite import CompositeStage, DrawView, GroundLight, Touched
from renderer.frame import Frame, RadianceFrame, RgbFrame, YuvFrame, check_size
from renderer.gl import Context, release_all
from renderer.gpu_mesh import GpuMesh, PlacedMesh
from renderer.inverse_tone_mapping import WEIGHTS, linear_from_radiance
from renderer.irradiance import disc_cosine, irradiance
from renderer.light_detection import MAX_LIGHTS, Light
from renderer.light_reading import FrameAccess, FrameLight, LightReader
from renderer.light_refinement import MomentStage
from renderer.light_visibility import Receiver
from renderer.mesh import Mesh
from renderer.openness import OpennessStage
from renderer.panorama import PanoramaTextures
from renderer.placement import TILE, TileMask, View, touched_tiles
from renderer.placing import Placement, Placer
from renderer.radiance_map import RadianceMapStage, packed_pixels
from renderer.ring_sampling import RingSource
from renderer.scene import Lighting, Scene
from renderer.shading import MIRROR_BELOW, Illumination, ShadingStage, is_sharp, may_mirror
from renderer.shadow_mapping import screen_space_occlusion
from renderer.shadows import ShadowMap, ShadowStage
from renderer.specular import MIN_ROUGHNESS, prefilter_all, quantized_roughness
from renderer.specular_floor import FloorBlurStage, SpecularFloor, lobe_spread
from renderer.surfaces import SurfaceStage
from renderer.surroundings import Surroundings
from renderer.threshold_detection import HEIGHT as THRESHOLD_HEIGHT
from renderer.threshold_detection import WIDTH as THRESHOLD_WIDTH
from renderer.timings import Timings

Array = NDArray[np.float64]
UP = np.array([0.0, 1.0, 0.0])
MIN_CAMERA_DISTANCE_M = 0.05
MIN_GROUND_SHARE = 0.02    # of the ground's irradiance; weaker lights cast no visible shadow


@dataclass(frozen=True)
class _Lit:
    """A placement under a light: what the ground receives, and the tiles of every shadow."""

    light: FrameLight
    lighting: Lighting
    placement: Placement
    ground: GroundLight | None
    maps: list[Touched]
    ambient: list[Touched]


@dataclass(frozen=True)
class TouchedRadiance:
    """(height, width, 3) radiance as it was composited, and the (height, width) mask of those pixels that have been touched."""

    rgb: NDArray[np.float32]
    mask: NDArray[np.bool_]


@dataclass(frozen=True)
class Rendered:
    """The composited frame; `errors` names the objects that could not be drawn and why. `touched`: of an RgbFrame, what its codes
    were rounded from; None where nothing was drawn."""

    frame: Frame
    light: FrameLight
    touched_fraction: float
    timings: Timings
    errors: dict[str, str]
    touched: TouchedRadiance | None = None


class Pipeline:
    """Renders frames of one kind and size. Owns all GL objects; use it on the context's thread only."""

    def __init__(self, context: Context, kind: type[Frame], size: tuple[int, int], *, assets: Path | None = None,
                 mesh_root: Path | None = None) -> None:
        self._context = context
        self._size = size
        self._panorama = PanoramaTextures(context, kind, size, packed_pixels(kind, size))
        self._radiance = RadianceMapStage(context, self._panorama)
        self._surfaces = SurfaceStage(context)
        self._shading = ShadingStage(context, self._panorama, self._surfaces, self._radiance.texture)
        self._shadows = ShadowStage(context, size, self._surfaces)
        self._composite = CompositeStage(context, self._panorama)
        self._openness = OpennessStage(context, self._surfaces)
        self._placer = Placer(self._upload, size, assets, mesh_root)
        self._reader = LightReader()
        self._surroundings = Surroundings()
        is_reduced = self._radiance.size[0] < size[0] or self._radiance.size[1] < size[1]
        self._moments = MomentStage(context, self._panorama, self._radiance.size) if is_reduced else None
        self._access = FrameAccess(self._upper_half, None if self._moments is None else self._moments.run)
        self._upper: RadianceMapStage | None = None     # made when it is first wanted
        self._rings: RingSource | None = None
        self._floor_blur: FloorBlurStage | None = None
        self._lit: _Lit | None = None
        self._illuminations = 0
        self._shadow_tiles: dict[tuple[ShadowMap, float], TileMask] = {}

    def _upload(self, mesh: Mesh) -> GpuMesh:
        uploaded = GpuMesh(self._context, self._surfaces.programs, mesh)
        self._openness.bake(uploaded)
        return uploaded

    @property
    def placement(self) -> Placement | None:
        """Where the objects of the scene that was rendered last stand."""
        return None if self._placer.last is None else self._placer.last[1]

    def analyse(self, frame: Frame, moment: float | None = None, lighting: Lighting | None = None) -> tuple[FrameLight, Timings]:
        """Find the light of a frame shown at `moment` seconds without compositing anything."""
        timings = Timings()
        with timings.stage("upload"):
            self._panorama.write(frame, only_packed=True)
            self._panorama.use()
        return self._light(timings, moment, lighting or Lighting()), timings

    def render(self, frame: Frame, scene: Scene, *, light: FrameLight | None = None, moment: float | None = None,
               output: YuvFrame | None = None) -> Rendered:
        """Composite the scene into the frame. The frame's own arrays stay as they are.

        `light` is that of an earlier frame, to light this one by; without it, it is read from this one first, which is shown
        at `moment` seconds. `output` are planes to write into, for a YuvFrame; without them there are new ones.
        """
        self._context.assert_own_thread()
        check_size(frame)
        timings = Timings()
        with timings.stage("place"):
            placement = self._placer.place(scene, moment)
        rings = scene.lighting.method("glossy") == "rings36" and bool(placement.objects)
        with timings.stage("upload"):
            self._panorama.write(frame, only_packed=not (rings or any(map(may_mirror, placement.objects.values()))))
            self._panorama.use()
        if light is None:
            light = self._light(timings, moment, scene.lighting)
        if rings:
            with timings.stage("glossy"):
                self._fill_rings(light)
        if not placement.objects:
            return Rendered(frame if output is None else _copied(frame, output), light, 0.0, timings, placement.errors)
        lit = self._light_scene(scene, light, placement, timings)
        with timings.stage("objects_and_composite"):
            draw_view = self._drawing(placement)
            touched = self._composite.run(placement.views, draw_view, lit.maps, lit.ambient, lit.ground, self._shadows,
                                          self._floor(scene, placement))
            self._context.start()   # while the planes are being copied
        with timings.stage("write"):
            composited, radiance = self._write(frame, touched, output)
        self._context.collect()
        fraction = len(touched) * TILE * TILE / (self._size[0] * self._size[1])
        return Rendered(composited, light, fraction, timings, placement.errors, radiance)

    def read_light(self, moment: float | None = None, lighting: Lighting | None = None) -> tuple[FrameLight, Timings]:
        """The light of the frame that was rendered last, which is shown at `moment` seconds."""
        timings = Timings()
        return self._light(timings, moment, lighting or Lighting()), timings

    def prepare(self, light: FrameLight) -> Timings:
        """Do now what the next frame would need first to be lit by this light, if its scene is that of the last frame."""
        timings = Timings()
        last = self._placer.last
        if last is not None and last[1].objects:
            scene, placement = last
            self._light_scene(scene, light, placement, timings)
            with timings.stage("objects_and_composite"):
                self._shading.draw_still(_still_views(placement), list(placement.objects.values()))
                self._context.gl.finish()
        return timings

    def compile_variants(self) -> None:
        """Have the driver compile every program that usual scenes need, now. After a frame with a light and an object."""
        if self._lit is not None:
            self._shading.compile_variants(self._lit.placement.views[0], list(self._lit.placement.objects.values()))
            self._composite.compile_variants()

    def _light(self, timings: Timings, moment: float | None, lighting: Lighting) -> FrameLight:
        with timings.stage("radiance_map"):
            radiance_map = self._radiance.run()
        return self._reader.read(radiance_map, self._access, lighting, moment, timings)

    def _fill_rings(self, light: FrameLight) -> None:
        if self._rings is None:
            self._rings = RingSource(self._context, self._panorama, self._radiance.size)
        width, height = self._radiance.size
        kept = np.ones((height, width), dtype=np.float32) if light.kept is None else light.kept
        self._rings.fill(kept, light.detection.threshold if light.method == "threshold" else 0.0)

    def _upper_half(self) -> NDArray[np.float32]:
        """The frame as the papers' detection wants it."""
        if self._upper is None:
            self._upper = RadianceMapStage(self._context, self._panorama, (THRESHOLD_WIDTH, THRESHOLD_HEIGHT))
        return self._upper.run_rows(THRESHOLD_HEIGHT // 2)

    def _light_scene(self, scene: Scene, light: FrameLight, placement: Placement, timings: Timings) -> _Lit:
        """What follows from light and placement together; kept until one of them is another."""
        if self._lit is not None and self._lit.light is light and self._lit.placement is placement and (
                self._lit.lighting == scene.lighting):
            return self._lit
        with timings.stage("glossy"):
            self._surfaces.keep([*placement.views, *placement.mirrored])
            rings = self._rings.texture if self._rings is not None and scene.lighting.method("glossy") == "rings36" else None
            if self._only_poses_differ(scene, light, placement):
                self._shading.set_receivers(*self._receivers(scene, placement))
            else:
                self._shading.set_illumination(self._illumination(scene, light, placement, rings))
        with timings.stage("shadows"):
            ground = self._ground_light(scene, light)
            maps, ambient = self._cast(scene, placement.objects, light, ground) if ground else ([], [])
            if rings is None:
                self._reflect_ground(placement, ground, maps, ambient)
        self._lit = _Lit(light, scene.lighting, placement, ground, maps, ambient)
        return self._lit

    def _only_poses_differ(self, scene: Scene, light: FrameLight, placement: Placement) -> bool:
        """From what the last illumination was made for."""
        return (self._lit is not None and self._lit.light is light and self._lit.lighting == scene.lighting
                and placement.is_later_than(self._lit.placement))

    def _illumination(self, scene: Scene, light: FrameLight, placement: Placement, rings: moderngl.Texture | None) -> Illumination:
        found = set().union(*(item.roughnesses for item in placement.objects.values()))
        wanted = {quantized_roughness(value) for value in found if value >= MIRROR_BELOW and rings is None}
        if rings is None and len(placement.objects) > 1 and any(map(may_mirror, placement.objects.values())):
            wanted.add(MIN_ROUGHNESS)       # for what one mirror sees in another
        lights = tuple(item for item in _rendered(light) if not item.is_wide)
        ground_y = -scene.camera_height if scene.ground.catcher else None
        # the papers' map knows nothing near
        near = () if scene.lighting.method("diffuse").startswith("map") else self._surroundings.fits(
            placement.objects, ground_y, light.soft, light.irradiance, lights)
        receivers, occluders = self._receivers(scene, placement)
        self._illuminations += 1
        lobes = prefilter_all(light.soft, wanted)
        return Illumination(light.irradiance, lights, lobes, ground_y, rings, near, receivers, occluders,
                            self._illuminations)

    def _receivers(self, scene: Scene, placement: Placement) -> tuple[tuple[Receiver, ...], tuple[Receiver, ...]]:
        """The objects, and the real things that are told of."""
        casting = {item.id for item in scene.objects if item.casts_shadow}
        bodies = self._surroundings.bodies(placement.objects)
        return (tuple(Receiver(placement.objects[name], body, name in casting) for name, body in bodies.items()),
                tuple(Receiver(item, self._surroundings.body(item), True) for item in placement.occluders))

    def _ground_light(self, scene: Scene, light: FrameLight) -> GroundLight | None:
        if not scene.ground.catcher:
            return None
        lights = [item.irradiance * float(disc_cosine(item.direction @ UP, item.angular_radius)) for item in _rendered(light)]
        ambient = np.maximum(irradiance(light.coefficients, UP), 0.0)
        return GroundLight(-scene.camera_height, ambient + sum(lights, np.zeros(3)), lights,
                           additive=scene.lighting.method("composite") == "additive")

    def _cast(self, scene: Scene, placed: dict[str, PlacedMesh], light: FrameLight,
              ground: GroundLight) -> tuple[list[Touched], list[Touched]]:
        filtered = scene.lighting.method("shadows") == "pcf"
        casters = {item.id: placed[item.id] for item in scene.objects if item.id in placed and item.casts_shadow}
        gate = MIN_GROUND_SHARE * float(ground.total @ WEIGHTS)
        self._shadows.begin(set(casters), {item.id for item in _rendered(light)})
        maps: list[ShadowMap | None] = []
        ambient: list[ShadowMap | None] = []
        for key, caster in casters.items():
            for index, item in enumerate(_rendered(light)):
                if ground.lights[index] @ WEIGHTS > gate:
                    maps.append(self._shadows.light_shadow(key, caster, item, index, ground.y, filtered=filtered))
            ambient.append(self._shadows.ambient_shadow(key, caster, ground.y))
        by_object = {key: shadow for key, shadow in zip(casters, ambient, strict=True) if shadow is not None}
        if filtered:
            self._shadows.weigh_ambient(list(by_object.values()), [screen_space_occlusion(light.coefficients)] * len(by_object))
        else:
            self._weigh_ambient(by_object, light, has_near=bool(self._shading.near))

        touched = self._touched([shadow for shadow in (*maps, *ambient) if shadow is not None], ground.y)
        return [item for item in touched if item.shadow.light >= 0], [item for item in touched if item.shadow.light < 0]

    def _weigh_ambient(self, shadows: dict[str, ShadowMap], light: FrameLight, *, has_near: bool) -> None:
        hidden = [light.coefficients[:9] for _ in shadows]
        for index, key in enumerate(shadows):
            given_back = self._surroundings.bounced(key) if has_near else None
            if given_back is not None:
                hidden[index] = hidden[index] - given_back
        self._shadows.weigh_ambient(list(shadows.values()), hidden)

    def _reflect_ground(self, placement: Placement, ground: GroundLight | None, maps: list[Touched],
                        ambient: list[Touched]) -> None:
        """Have the ground's shadows ready for those objects that are smooth enough to show them."""
        objects = placement.objects.values()
        if ground is not None and any(item.is_detailed or any(map(is_sharp, item.surfaces)) for item in objects):
            self._shading.ground_missing.draw([item.shadow for item in maps], [item.shadow for item in ambient], ground.lights,
                                              ground.total, self._shadows)

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
        return lambda view: self._shading.draw(view, objects)

    def _floor(self, scene: Scene, placement: Placement) -> SpecularFloor | None:
        """How the ground mirrors the objects."""
        if not placement.mirrored:
            return None
        objects = list(placement.objects.values())
        spread = lobe_spread(scene.ground.roughness)
        if spread > 0 and self._floor_blur is None:
            self._floor_blur = FloorBlurStage(self._context)

        def picture(view: View) -> moderngl.Texture:
            target, number = self._shading.picture(view, objects)
            return target.texture if self._floor_blur is None or spread == 0 else self._floor_blur.run(view, target, number, spread)

        return SpecularFloor(placement.mirrored, picture, scene.ground.specular, self._radiance.texture if spread > 0 else None)

    def _write(self, frame: Frame, tiles: NDArray[np.intp], output: YuvFrame | None) -> tuple[Frame, TouchedRadiance | None]:
        if isinstance(frame, YuvFrame):
            composited = _copied(frame, output)
            self._composite.write_yuv(composited, tiles)
            return composited, None
        radiance, touched = self._composite.touched_radiance(tiles, frame)
        if isinstance(frame, RadianceFrame):
            return RadianceFrame(np.where(touched[..., None], radiance, frame.rgb)), None
        signal = srgb_from_linear(np.clip(linear_from_radiance(radiance), 0.0, 1.0))
        codes = np.where(touched[..., None], np.round(signal * 255).astype(np.uint8), frame.rgb)
        return RgbFrame(codes), TouchedRadiance(radiance, touched)

    def reset(self) -> None:
        """Forget the lights of earlier frames."""
        self._reader.reset()
        for stage in (self._surroundings, self._shadows, self._shading):
            stage.reset()

    def release(self) -> None:
        self._context.rest()
        self._placer.release()
        self._openness.release()
        release_all(self._composite, self._shadows, self._shading, self._surfaces, self._upper, self._rings, self._moments,
                    self._floor_blur, self._radiance, self._panorama)


def _still_views(placement: Placement) -> list[View]:
    """Those that no animation changes before the next frame."""
    moving = {index for index, name in enumerate(placement.objects) if name in placement.moving}
    return [view for view in (*placement.views, *placement.mirrored) if not moving & set(view.members)]


def _copied(frame: Frame, output: YuvFrame | None) -> YuvFrame:
    assert isinstance(frame, YuvFrame)
    if output is None:
        return frame.copy()
    for target, source in ((output.y, frame.y), (output.u, frame.u), (output.v, frame.v)):
        np.copyto(target, source)
    return output


def _rendered(light: FrameLight) -> tuple[Light, ...]:
    """The strongest lights; the methods of the papers set no limit to their number."""
    return light.detection.lights[:MAX_LIGHTS]

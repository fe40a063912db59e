"""The renderer: one frame and one scene in, the composited frame and its lights out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import moderngl
import numpy as np
from numpy.typing import NDArray

from renderer.color import srgb_from_linear
from renderer.compositing.composite import CompositeStage, DrawView, Output
from renderer.compositing.kept_layers import KeptLayers, keeps_layers
from renderer.frame import Frame, RadianceFrame, RgbFrame, YuvFrame, check_size
from renderer.gl import Context, release_all
from renderer.light.inverse_tone_mapping import linear_from_radiance
from renderer.light.radiance_map import RadianceMapStage, packed_pixels
from renderer.light.reading import FrameAccess, FrameLight, LightReader
from renderer.light.refinement import MomentStage
from renderer.light.ring_sampling import RingSource
from renderer.light.threshold_detection import HEIGHT as THRESHOLD_HEIGHT
from renderer.light.threshold_detection import WIDTH as THRESHOLD_WIDTH
from renderer.models.gpu_mesh import GpuMesh
from renderer.models.mesh import Mesh
from renderer.models.openness import OpennessStage
from renderer.objects.placement import TILE, View
from renderer.objects.placing import Placement, Placer
from renderer.objects.shading import ShadingStage, may_mirror
from renderer.objects.specular_floor import FloorBlurStage, SpecularFloor, lobe_spread
from renderer.objects.surfaces import SurfaceStage
from renderer.panorama import PanoramaTextures
from renderer.quality import Quality
from renderer.scene import Lighting, Scene
from renderer.scene_light import LitScene, SceneLightStage
from renderer.timings import Timings

STEADY_FRAMES = 2       # under the same light, after which most objects look the same too


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
        self.new_timings: Callable[[], Timings] = Timings      # what measures the stages of a call
        self._panorama = PanoramaTextures(context, kind, size, packed_pixels(kind, size))
        self._radiance = RadianceMapStage(context, self._panorama)
        self._surfaces = SurfaceStage(context)
        self._shading = ShadingStage(context, self._panorama, self._surfaces, self._radiance.texture)
        self._composite = CompositeStage(context, self._panorama, Output.CODES if kind is YuvFrame else Output.RADIANCE)
        self._kept = KeptLayers(context, self._panorama) if keeps_layers(context, self._panorama) else None
        self._openness = OpennessStage(context, self._surfaces)
        self._placer = Placer(self._upload, size, assets, mesh_root)
        self._reader = LightReader()
        self._scene_light = SceneLightStage(context, size, self._surfaces, self._shading)
        self._last_light: FrameLight | None = None
        self._steady = 0        # frames since it was another
        is_reduced = self._radiance.size[0] < size[0] or self._radiance.size[1] < size[1]
        self._moments = MomentStage(context, self._panorama, self._radiance.size) if is_reduced else None
        self._access = FrameAccess(self._upper_half, None if self._moments is None else self._moments.run)
        self._upper: RadianceMapStage | None = None     # made when it is first wanted
        self._rings: RingSource | None = None
        self._floor_blur: FloorBlurStage | None = None

    def _upload(self, mesh: Mesh) -> GpuMesh:
        uploaded = GpuMesh(self._context, self._surfaces.programs, mesh)
        self._openness.bake(uploaded)
        return uploaded

    @property
    def quality(self) -> Quality:
        """How accurate live frames are; may be set between two of them."""
        return self._scene_light.quality

    @quality.setter
    def quality(self, quality: Quality) -> None:
        self._scene_light.quality = quality

    @property
    def placement(self) -> Placement | None:
        """Where the objects of the scene that was rendered last stand."""
        return None if self._placer.last is None else self._placer.last[1]

    def analyse(self, frame: Frame, moment: float | None = None, lighting: Lighting | None = None) -> tuple[FrameLight, Timings]:
        """Find the light of a frame shown at `moment` seconds without compositing anything."""
        timings = self.new_timings()
        self._panorama.show(frame)
        return self._light(timings, moment, lighting or Lighting()), timings

    def render(self, frame: Frame, scene: Scene, *, light: FrameLight | None = None, moment: float | None = None,
               output: YuvFrame | None = None) -> Rendered:
        """Composite the scene into the frame. The frame's own arrays stay as they are.

        `light` is that of an earlier frame, to light this one by; without it, it is read from this one first, which is shown
        at `moment` seconds. `output` are planes to write into, for a YuvFrame; without them there are new ones.
        """
        self._context.assert_own_thread()
        check_size(frame)
        timings = self.new_timings()
        with timings.stage("place"):
            placement = self._placer.place(scene, moment)
        rings = scene.lighting.method("glossy") == "rings36" and bool(placement.objects)
        self._panorama.show(frame)
        self._scene_light.begin_frame(patient=light is not None)
        if light is None:
            light = self._light(timings, moment, scene.lighting)
        if rings:
            with timings.stage("glossy"):
                self._fill_rings(light)
        if not placement.objects:
            return Rendered(frame if output is None else _copied(frame, output), light, 0.0, timings, placement.errors)
        lit = self._scene_light.run(scene, light, placement, self._rings_for(scene), timings)
        kept = self._kept_for(lit)
        self._shading.mirrors_apart = kept is not None
        if rings or kept is None:
            with timings.stage("upload"):
                self._panorama.upload(plain=rings or any(map(may_mirror, placement.objects.values())))
        with timings.stage("objects_and_composite"):
            touched = self._draw_tiles(scene, lit, kept)
            self._scene_light.end_frame()
            self._context.start()   # while the planes are being copied
        with timings.stage("write"):
            composited, radiance = self._write(frame, kept, touched, output)
        self._context.collect()
        fraction = len(touched) * TILE * TILE / (self._size[0] * self._size[1])
        return Rendered(composited, light, fraction, timings, placement.errors, radiance)

    def read_light(self, moment: float | None = None, lighting: Lighting | None = None) -> tuple[FrameLight, Timings]:
        """The light of the frame that was rendered last, which is shown at `moment` seconds."""
        timings = self.new_timings()
        return self._light(timings, moment, lighting or Lighting()), timings

    def prepare(self, light: FrameLight) -> Timings:
        """Do now what the next frame would need first to be lit by this light, if its scene is that of the last frame."""
        timings = self.new_timings()
        last = self._placer.last
        if last is not None and last[1].objects:
            scene, placement = last
            lit = self._scene_light.run(scene, light, placement, self._rings_for(scene), timings)
            with timings.stage("objects_and_composite"):
                self._scene_light.draw_ahead(lit, _still_views(placement))
                self._context.gl.finish()
        return timings

    @property
    def is_behind(self) -> bool:
        """Whether objects are still shown in an older light than was prepared last; to `prepare` it again shades more of them."""
        return self._shading.is_behind

    def compile_variants(self) -> None:
        """Have the driver compile every program that usual scenes need, now. After a frame with a light and an object."""
        lit, last = self._scene_light.last, self._placer.last
        if lit is None or last is None:
            return
        self._panorama.upload(plain=True)
        self._shading.compile_variants(lit.placement.views[0], list(lit.placement.objects.values()))
        for kept in (None, self._kept):
            self._shading.mirrors_apart = kept is not None
            self._draw_tiles(last[0], lit, kept)
            (kept or self._composite).compile_variants()

    def _light(self, timings: Timings, moment: float | None, lighting: Lighting) -> FrameLight:
        with timings.stage("radiance_map"):
            radiance_map = self._radiance.run()
        return self._reader.read(radiance_map, self._access, lighting, moment, timings)

    def _rings_for(self, scene: Scene) -> moderngl.Texture | None:
        return None if self._rings is None or scene.lighting.method("glossy") != "rings36" else self._rings.texture

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

    def _kept_for(self, lit: LitScene) -> KeptLayers | None:
        """The layers, unless the light is another every few frames, when there is little to keep, or a floor mirrors, which depends
        on other pixels too."""
        self._steady = self._steady + 1 if lit.light is self._last_light else 0
        self._last_light = lit.light
        return None if lit.placement.mirrored or self._steady < STEADY_FRAMES else self._kept

    def _draw_tiles(self, scene: Scene, lit: LitScene, kept: KeptLayers | None) -> NDArray[np.integer]:
        """Returns the touched tiles, one a row."""
        placement, draw_view, atlases = lit.placement, self._drawing(lit.placement), self._scene_light.atlases
        if kept is not None:
            return kept.run(placement.views, draw_view, lit.maps, lit.ambient, lit.ground, atlases, lit.catchers)
        return self._composite.run(placement.views, draw_view, lit.maps, lit.ambient, lit.ground, atlases,
                                   self._floor(scene, placement), lit.catchers)

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

    def _write(self, frame: Frame, kept: KeptLayers | None, tiles: NDArray[np.integer],
               output: YuvFrame | None) -> tuple[Frame, TouchedRadiance | None]:
        if isinstance(frame, YuvFrame):
            composited = _copied(frame, output)
            if kept is not None:
                kept.write(composited, frame, self._radiance)
            else:
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
        for stage in (self._scene_light, self._shading):
            stage.reset()

    def release(self) -> None:
        self._context.rest()
        self._placer.release()
        self._openness.release()
        release_all(self._composite, self._kept, self._shading, self._surfaces, self._upper, self._rings, self._moments,
                    self._floor_blur, self._scene_light, self._radiance, self._panorama)


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

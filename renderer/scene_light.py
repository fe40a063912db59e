"""A placed scene under the light of a frame: what lights its objects, and what they take from the ground and from real things."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil

import moderngl
import numpy as np
from numpy.typing import NDArray

from renderer.compositing.composite import GroundLight
from renderer.gl import Context, release_all
from renderer.light.change import hardly_changed
from renderer.light.detection import MAX_LIGHTS, Light
from renderer.light.inverse_tone_mapping import WEIGHTS
from renderer.light.irradiance import disc_cosine, irradiance
from renderer.light.reading import FrameLight
from renderer.light.specular import MIN_ROUGHNESS, Lobe, prefilter_all, quantized_roughness
from renderer.models.gpu_mesh import PlacedMesh
from renderer.objects.placement import TileMask, View, tile_grid
from renderer.objects.placing import Placement
from renderer.objects.shading import MIRROR_BELOW, Illumination, ShadingStage, is_sharp, may_mirror
from renderer.objects.surface_table import coat_roughness
from renderer.objects.surfaces import SurfaceStage
from renderer.objects.surroundings import Surroundings
from renderer.quality import FULL, Quality
from renderer.scene import Lighting, Scene
from renderer.shadows.ambient_shadows import AmbientShadowStage
from renderer.shadows.catchers import CatcherLayer, CatcherLight, CatcherStage
from renderer.shadows.light_shadows import LightShadowStage
from renderer.shadows.light_visibility import Receiver
from renderer.shadows.shadow_atlas import ShadowAtlases, ShadowMap
from renderer.shadows.shadow_casters import RealThings
from renderer.shadows.shadow_mapping import screen_space_occlusion
from renderer.shadows.shadow_reach import surrounds_camera
from renderer.timings import Timings

Array = NDArray[np.float64]
UP = np.array([0.0, 1.0, 0.0])
SETTLED_READINGS = 16      # of the same light: shadows are drawn finely and near fields fitted to it, one after another


@dataclass(frozen=True)
class LitScene:
    """A placement under a light: what the ground receives, and the tiles of every shadow."""

    light: FrameLight
    lighting: Lighting
    placement: Placement
    ground: GroundLight
    maps: list[ShadowMap]
    ambient: list[ShadowMap]
    catchers: CatcherLayer | None


class SceneLightStage:
    """Keeps what it found until light or placement is another. Owns the surroundings and the stage of real surfaces."""

    def __init__(self, context: Context, size: tuple[int, int], surfaces: SurfaceStage, shading: ShadingStage) -> None:
        self._context, self._size = context, size
        self._surfaces, self._shading = surfaces, shading
        self._light_shadows = LightShadowStage(context, size, surfaces)
        self._ambient_shadows = AmbientShadowStage(context, size)
        self._surroundings = Surroundings()
        self._catchers: CatcherStage | None = None      # made when it is first wanted
        self._last: LitScene | None = None
        self._given: FrameLight | None = None
        self._reference: FrameLight | None = None       # the light that has stayed the same
        self._unchanged = 0                             # for so many readings
        self._illuminations = 0
        self._lobes: dict[float, Lobe] = {}
        self._lobes_without: tuple[int, ...] = ()       # lights (ids)
        self._quality = FULL

    @property
    def quality(self) -> Quality:
        return self._quality

    @quality.setter
    def quality(self, quality: Quality) -> None:
        self._quality = self._shading.quality = self._light_shadows.quality = quality

    def begin_frame(self, *, patient: bool) -> None:
        """`patient`: what only the light has changed may be lit anew in one of the next frames."""
        self._shading.is_patient = patient
        if self._catchers is not None:
            self._catchers.begin_frame(patient=patient)

    def end_frame(self) -> None:
        """What is drawn from now on is for the next one."""
        if self._catchers is not None:
            self._catchers.end_frame()

    def draw_ahead(self, lit: LitScene, views: list[View]) -> None:
        """Draw some of what the next frame needs of a scene; `views`: those that nothing changes before it."""
        if self._catchers is not None and lit.catchers is not None:
            self._catchers.draw_ahead(lit.catchers.views)
        self._shading.draw_still(views, list(lit.placement.objects.values()))

    @property
    def atlases(self) -> ShadowAtlases:
        return ShadowAtlases(self._light_shadows.atlas, self._ambient_shadows.atlas)

    @property
    def last(self) -> LitScene | None:
        return self._last

    def run(self, scene: Scene, light: FrameLight, placement: Placement, rings: moderngl.Texture | None,
            timings: Timings) -> LitScene:
        """Light a placed scene. `rings`: the frame with mip levels where the papers' glossy method is in use."""
        last, is_new = self._last, light is not self._given
        if last is not None and not is_new and last.placement is placement and last.lighting == scene.lighting:
            return last
        self._given = light
        light = self._held(light, placement, is_new=is_new)
        with timings.stage("glossy"):
            if self._only_poses_differ(scene, light, placement):
                self._shading.set_receivers(*self._receivers(scene, placement))
            else:
                self._shading.set_illumination(self._illumination(scene, light, placement, rings))
        with timings.stage("shadows"):
            ground = self._ground_light(scene, light)
            maps, ambient = self._cast(scene, placement, light, ground) if scene.ground.catcher else ([], [])
            if rings is None and scene.ground.catcher:
                self._reflect_ground(placement, ground, maps, ambient)
            catchers = self._catch(scene, placement, light, ground, [item.tiles for item in (*maps, *ambient)])
        self._surfaces.keep([*placement.views, *placement.mirrored, *(catchers.views if catchers is not None else ())])
        self._last = LitScene(light, scene.lighting, placement, ground, maps, ambient, catchers)
        return self._last

    def _held(self, light: FrameLight, placement: Placement, *, is_new: bool) -> FrameLight:
        """The last light instead of this one, if nothing moves and it has stayed the same for so long that all is settled."""
        last, reference = self._last, self._reference
        if last is None or reference is None or not placement.is_later_than(last.placement) or not hardly_changed(reference, light):
            self._reference, self._unchanged = light, 0
            return light
        self._unchanged += is_new
        return last.light if self._unchanged > max(SETTLED_READINGS, 2 * len(placement.objects)) else light

    def _only_poses_differ(self, scene: Scene, light: FrameLight, placement: Placement) -> bool:
        """From what the last illumination was made for."""
        return (self._last is not None and self._last.light is light and self._last.lighting == scene.lighting
                and placement.is_later_than(self._last.placement))

    def _illumination(self, scene: Scene, light: FrameLight, placement: Placement, rings: moderngl.Texture | None) -> Illumination:
        found = set().union(*(item.roughnesses for item in placement.objects.values()))
        wanted = {quantized_roughness(value) for value in found if value >= MIRROR_BELOW and rings is None}
        if rings is None and len(placement.objects) > 1 and any(map(may_mirror, placement.objects.values())):
            wanted.add(MIN_ROUGHNESS)       # for what one mirror sees in another
        if rings is None:
            wanted |= {quantized_roughness(coat_roughness(surface)) for item in placement.objects.values()
                       for surface in item.surfaces if surface.clearcoat > 0}
        lights = tuple(item for item in _rendered(light) if not item.is_wide)
        ground_y = -scene.camera_height if scene.ground.catcher else None
        # the papers' map knows nothing near
        near = () if scene.lighting.method("diffuse").startswith("map") else self._surroundings.fits(
            placement.objects, ground_y, light.soft, light.irradiance, lights)
        receivers, occluders = self._receivers(scene, placement)
        self._illuminations += 1
        return Illumination(light.irradiance, lights, self._prefiltered(light, wanted), ground_y, rings, near, receivers, occluders,
                            self._illuminations)

    def _prefiltered(self, light: FrameLight, wanted: set[float]) -> dict[float, Lobe]:
        """Maps prefiltered for these roughness values; where they may wait and all lights are still there, some of them from this
        frame, in turn."""
        lights = tuple(one.id for one in light.detection.lights)
        kept = {value: lobe for value, lobe in self._lobes.items() if value in wanted and lights == self._lobes_without}
        due = ceil(self._quality.lobe_share * len(kept)) if self._shading.is_patient else len(kept)
        old = list(kept)[:due]      # the first are the oldest
        new = prefilter_all(light.soft, (wanted - kept.keys()) | set(old))
        self._lobes, self._lobes_without = {**{value: kept[value] for value in kept if value not in new}, **new}, lights
        return self._lobes

    def _receivers(self, scene: Scene, placement: Placement) -> tuple[tuple[Receiver, ...], tuple[Receiver, ...]]:
        """The objects, and the real things that are told of."""
        casting = {item.id for item in scene.objects if item.casts_shadow}
        bodies = self._surroundings.bodies(placement.objects)
        return (tuple(Receiver(placement.objects[name], body, name in casting) for name, body in bodies.items()),
                self._real(placement.occluders))

    def _real(self, things: tuple[PlacedMesh, ...]) -> tuple[Receiver, ...]:
        """Real things; what is around the camera, as a room is, hides no light."""
        bodies = [self._surroundings.body(item) for item in things]
        return tuple(Receiver(item, body, not surrounds_camera(body)) for item, body in zip(things, bodies, strict=True))

    def _catch(self, scene: Scene, placement: Placement, light: FrameLight, ground: GroundLight,
               shadows: list[TileMask]) -> CatcherLayer | None:
        """How real surfaces receive the objects' shadows and hide the ground's. `shadows`: the tiles of those."""
        if not placement.catchers and not (placement.occluders and shadows):
            return None
        if self._catchers is None:
            self._catchers = CatcherStage(self._context, self._size, self._surfaces)
        objects = self._receivers(scene, placement)[0]
        given_back = tuple(self._surroundings.bounced(name) if self._shading.near else None for name in placement.objects)
        tiles = np.logical_or.reduce(shadows) if shadows else np.zeros(tile_grid(self._size)[::-1], dtype=bool)
        views = self._catchers.set_scene(
            self._real(placement.catchers), self._real(placement.occluders), objects,
            CatcherLight(light.coefficients, _rendered(light), given_back, ground.total if ground.additive else None), tiles)
        return CatcherLayer(views, self._catchers.picture)

    def _ground_light(self, scene: Scene, light: FrameLight) -> GroundLight:
        lights = [item.irradiance * float(disc_cosine(item.direction @ UP, item.angular_radius)) for item in _rendered(light)]
        ambient = np.maximum(irradiance(light.coefficients, UP), 0.0)
        return GroundLight(-scene.camera_height, ambient + sum(lights, np.zeros(3)), lights,
                           additive=scene.lighting.method("composite") == "additive")

    def _cast(self, scene: Scene, placement: Placement, light: FrameLight,
              ground: GroundLight) -> tuple[list[ShadowMap], list[ShadowMap]]:
        placed = placement.objects
        filtered = scene.lighting.method("shadows") == "pcf"
        casters = {item.id: placed[item.id] for item in scene.objects if item.id in placed and item.casts_shadow}
        gate = self._quality.min_ground_share * float(ground.total @ WEIGHTS)
        things = () if filtered else self._real((*placement.catchers, *placement.occluders))
        real = RealThings([(item.placed, item.body.solid) for item in things])
        self._light_shadows.begin(set(casters), {item.id for item in _rendered(light)}, real)
        maps = [shadow for index, item in enumerate(_rendered(light)) if ground.lights[index] @ WEIGHTS > gate
                for shadow in self._light_shadows.run(casters, item, index, ground.y, filtered=filtered)]
        share = 1 - float(sum(ground.lights, np.zeros(3)) @ WEIGHTS) / max(float(ground.total @ WEIGHTS), 1e-9)
        ambient = self._ambient_shadows.run(casters, self._hidden(list(casters), light, filtered=filtered), ground.y, real, share)
        return maps, ambient

    def _hidden(self, names: list[str], light: FrameLight, *, filtered: bool) -> dict[str, Array]:
        """Of each object (9, 3) coefficients of what it hides, less what it gives back."""
        if filtered:
            return dict.fromkeys(names, screen_space_occlusion(light.coefficients))
        given_back = {name: self._surroundings.bounced(name) if self._shading.near else None for name in names}
        return {name: light.coefficients[:9] if back is None else light.coefficients[:9] - back
                for name, back in given_back.items()}

    def _reflect_ground(self, placement: Placement, ground: GroundLight, maps: list[ShadowMap],
                        ambient: list[ShadowMap]) -> None:
        """Have the ground's shadows ready for those objects that are smooth enough to show them."""
        objects = placement.objects.values()
        if any(item.is_detailed or any(map(is_sharp, item.surfaces)) for item in objects):
            self._shading.ground_missing.draw(maps, ambient, ground.lights, ground.total, self.atlases)

    def reset(self) -> None:
        """The next light has nothing to do with the last one."""
        self._reference, self._lobes = None, {}
        self._surroundings.reset()
        self._light_shadows.reset()
        if self._catchers is not None:
            self._catchers.reset()

    def release(self) -> None:
        release_all(self._catchers, self._light_shadows, self._ambient_shadows)


def _rendered(light: FrameLight) -> tuple[Light, ...]:
    """The strongest lights; the methods of the papers set no limit to their number."""
    return light.detection.lights[:MAX_LIGHTS]

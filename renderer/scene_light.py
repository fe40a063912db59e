"""A placed scene under the light of a frame: what lights its objects, and what they take from the ground and from real things."""

from __future__ import annotations

from dataclasses import dataclass

import moderngl
import numpy as np

from renderer.catchers import CatcherLayer, CatcherLight, CatcherStage
from renderer.composite import GroundLight
from renderer.gl import Context, release_all
from renderer.gpu_mesh import PlacedMesh
from renderer.inverse_tone_mapping import WEIGHTS
from renderer.irradiance import disc_cosine, irradiance
from renderer.light_detection import MAX_LIGHTS, Light
from renderer.light_reading import FrameLight
from renderer.light_visibility import Receiver
from renderer.placement import TileMask, tile_grid, touched_tiles
from renderer.placing import Placement
from renderer.scene import Lighting, Scene
from renderer.shading import MIRROR_BELOW, Illumination, ShadingStage, is_sharp, may_mirror
from renderer.shadow_mapping import screen_space_occlusion
from renderer.shadow_reach import surrounds_camera
from renderer.shadows import ShadowMap, ShadowStage
from renderer.specular import MIN_ROUGHNESS, prefilter_all, quantized_roughness
from renderer.surfaces import SurfaceStage
from renderer.surroundings import Surroundings
from renderer.tile_plan import Touched
from renderer.timings import Timings

UP = np.array([0.0, 1.0, 0.0])
MIN_GROUND_SHARE = 0.02    # of the ground's irradiance; weaker lights cast no visible shadow


@dataclass(frozen=True)
class LitScene:
    """A placement under a light: what the ground receives, and the tiles of every shadow."""

    light: FrameLight
    lighting: Lighting
    placement: Placement
    ground: GroundLight
    maps: list[Touched]
    ambient: list[Touched]
    catchers: CatcherLayer | None


class SceneLightStage:
    """Keeps what it found until light or placement is another. Owns the surroundings and the stage of real surfaces."""

    def __init__(self, context: Context, size: tuple[int, int], surfaces: SurfaceStage, shading: ShadingStage,
                 shadows: ShadowStage) -> None:
        self._context, self._size = context, size
        self._surfaces, self._shading, self._shadows = surfaces, shading, shadows
        self._surroundings = Surroundings()
        self._catchers: CatcherStage | None = None      # made when it is first wanted
        self._last: LitScene | None = None
        self._illuminations = 0
        self._shadow_tiles: dict[tuple[ShadowMap, float], TileMask] = {}

    @property
    def last(self) -> LitScene | None:
        return self._last

    def run(self, scene: Scene, light: FrameLight, placement: Placement, rings: moderngl.Texture | None,
            timings: Timings) -> LitScene:
        """Light a placed scene. `rings`: the frame with mip levels where the papers' glossy method is in use."""
        if self._last is not None and self._last.light is light and self._last.placement is placement and (
                self._last.lighting == scene.lighting):
            return self._last
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

    def _only_poses_differ(self, scene: Scene, light: FrameLight, placement: Placement) -> bool:
        """From what the last illumination was made for."""
        return (self._last is not None and self._last.light is light and self._last.lighting == scene.lighting
                and placement.is_later_than(self._last.placement))

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
              ground: GroundLight) -> tuple[list[Touched], list[Touched]]:
        placed = placement.objects
        filtered = scene.lighting.method("shadows") == "pcf"
        casters = {item.id: placed[item.id] for item in scene.objects if item.id in placed and item.casts_shadow}
        gate = MIN_GROUND_SHARE * float(ground.total @ WEIGHTS)
        real = [] if filtered else self._real((*placement.catchers, *placement.occluders))
        self._shadows.begin(set(casters), {item.id for item in _rendered(light)},
                            [(item.placed, item.body.solid) for item in real])
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

    def _reflect_ground(self, placement: Placement, ground: GroundLight, maps: list[Touched],
                        ambient: list[Touched]) -> None:
        """Have the ground's shadows ready for those objects that are smooth enough to show them."""
        objects = placement.objects.values()
        if any(item.is_detailed or any(map(is_sharp, item.surfaces)) for item in objects):
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

    def reset(self) -> None:
        """The next light has nothing to do with the last one."""
        self._surroundings.reset()
        if self._catchers is not None:
            self._catchers.reset()

    def release(self) -> None:
        release_all(self._catchers)


def _rendered(light: FrameLight) -> tuple[Light, ...]:
    """The strongest lights; the methods of the papers set no limit to their number."""
    return light.detection.lights[:MAX_LIGHTS]

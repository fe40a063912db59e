"""From a scene to meshes in the world, at one moment of its animations, and the views that show them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from renderer.models.gltf import GltfError, transform
from renderer.models.gpu_mesh import GpuMesh, PlacedMesh
from renderer.models.mesh import Mesh, Surface
from renderer.models.mesh_library import MeshLibrary
from renderer.objects.placement import View, plan_views, touched_tiles
from renderer.objects.specular_floor import mirrored_views
from renderer.scene import LocalSurface, Scene, SceneObject

Array = NDArray[np.float64]
MIN_CAMERA_DISTANCE_M = 0.05


@dataclass(frozen=True)
class Placement:
    """The objects that can be drawn, by id; the real things that hide them, and those that receive their shadows; the views that
    show the objects; what is wrong with others.

    `moving` are the ids of objects that an animation moves from frame to frame.
    """

    objects: dict[str, PlacedMesh]
    occluders: tuple[PlacedMesh, ...]
    catchers: tuple[PlacedMesh, ...]
    views: list[View]
    errors: dict[str, str]
    moving: frozenset[str]
    number: int = 0         # the same for the moments of one scene
    mirrored: tuple[View, ...] = ()     # views of the objects in a specular ground

    def is_later_than(self, other: Placement) -> bool:
        """Whether the two differ by nothing but poses."""
        return self.number == other.number


class Placer:
    """Owns the meshes. Keeps what it placed until the scene, a model's file or a pose changes."""

    def __init__(self, upload: Callable[[Mesh], GpuMesh], size: tuple[int, int], assets: Path | None,
                 mesh_root: Path | None) -> None:
        self._meshes = MeshLibrary(upload, assets, mesh_root)
        self._size = size
        self._poses, self._numbers = itertools.count(1), itertools.count(1)
        self._last: tuple[Scene, dict[str, float], Placement] | None = None

    @property
    def last(self) -> tuple[Scene, Placement] | None:
        """The scene that was placed last, and how."""
        return None if self._last is None else (self._last[0], self._last[2])

    def place(self, scene: Scene, moment: float | None) -> Placement:
        """The scene's visible objects at `moment` seconds of its animations; None is their beginning."""
        names = [item.mesh for item in (*scene.objects, *scene.local_scene)]
        files = self._meshes.state(names)
        last = self._last
        if last is not None and last[0] is scene and last[1] == files:
            if not last[2].moving:
                return last[2]
            placement = self._moved(scene, last[2], moment or 0.0)
        else:
            placement = self._placed(scene, moment or 0.0)
        if last is not None:
            placement = _with_kept_views(placement, last[2])
        self._last = (scene, self._meshes.state(names), placement)
        return placement

    def _placed(self, scene: Scene, moment: float) -> Placement:
        objects: dict[str, PlacedMesh] = {}
        errors: dict[str, str] = {}
        moving = set()
        for item in (one for one in scene.objects if one.visible):
            try:
                found = self._object(item, moment, errors)
            except GltfError as error:
                errors[item.id] = str(error)
                continue
            wrong = _misplaced(item, found, scene)
            if wrong is not None:
                errors[item.id] = wrong
            else:
                objects[item.id] = found
                if found.pose is not None:
                    moving.add(item.id)
        self._meshes.keep({(item.mesh, item.id) for item in scene.objects if item.animation is not None})
        local = [(item.role, self._local(item, errors)) for item in scene.local_scene]
        occluders, catchers = (tuple(placed for role, placed in local if role == wanted and placed is not None)
                               for wanted in ("occluder", "catcher"))
        return self._viewed(Placement(objects, occluders, catchers, [], errors, frozenset(moving), next(self._numbers)), scene)

    def _moved(self, scene: Scene, before: Placement, moment: float) -> Placement:
        """The same with the poses of another moment."""
        objects = dict(before.objects)
        for item in scene.objects:
            if item.id in before.moving:
                placed = objects[item.id]
                objects[item.id] = self._posed(item, placed, moment)
        return self._viewed(replace(before, objects=objects), scene)

    def _viewed(self, placement: Placement, scene: Scene) -> Placement:
        outlines = [item.outline() for item in placement.objects.values()]
        tiles = [touched_tiles(points, self._size) for points in outlines]
        return replace(placement, views=plan_views(outlines, tiles, self._size),
                       mirrored=mirrored_views(outlines, scene.ground, -scene.camera_height, self._size))

    def _object(self, item: SceneObject, moment: float, errors: dict[str, str]) -> PlacedMesh:
        clip = None if item.animation is None else item.animation.clip
        mesh = self._meshes.get(item.mesh, item.id if clip is not None else "")
        placed = PlacedMesh(mesh, transform(item.position, item.rotation, item.scale), _surface(item, mesh))
        if clip is None:
            return placed
        try:
            return self._posed(item, placed, moment)
        except ValueError as error:
            errors[item.id] = str(error)
            return placed

    def _posed(self, item: SceneObject, placed: PlacedMesh, moment: float) -> PlacedMesh:
        """Raises ValueError when the model has no such clip."""
        assert item.animation is not None
        seconds = moment * item.animation.speed
        pose = placed.mesh.mesh.pose(item.animation.clip, seconds if math.isfinite(seconds) else 0.0, item.animation.loop)
        return replace(placed, pose=pose, pose_number=next(self._poses))

    def _local(self, item: LocalSurface, errors: dict[str, str]) -> PlacedMesh | None:
        try:
            return PlacedMesh(self._meshes.get(item.mesh), transform(item.position, item.rotation, item.scale),
                              Surface(double_sided=True))       # a room hides what is outside it
        except GltfError as error:
            errors[item.id] = str(error)
            return None

    def release(self) -> None:
        self._meshes.release()


def _with_kept_views(placement: Placement, before: Placement) -> Placement:
    """With the views of `before` where they show the same: what was drawn for them then still holds."""
    now, then = ([item.state() for item in one.objects.values()] for one in (placement, before))
    hidden = [[item.state() for item in one.occluders] for one in (placement, before)]
    if hidden[0] != hidden[1]:
        return placement
    views, mirrored = ([next((old for old in olds if _shows_the_same(view, old, now, then)), view) for view in views]
                       for views, olds in ((placement.views, before.views), (placement.mirrored, before.mirrored)))
    return replace(placement, views=views, mirrored=tuple(mirrored))


def _shows_the_same(view: View, old: View, now: list[bytes], then: list[bytes]) -> bool:
    return (view.members == old.members and view.size == old.size and view.cube_axis == old.cube_axis
            and view.bounds == old.bounds and np.array_equal(view.rotation, old.rotation)
            and view.depth_range == old.depth_range and view.mirror_y == old.mirror_y and np.array_equal(view.tiles, old.tiles)
            and [now[i] for i in view.members] == [then[i] for i in old.members])


def _misplaced(item: SceneObject, placed: PlacedMesh, scene: Scene) -> str | None:
    """What is wrong with an object's place, if anything."""
    points = placed.outline()
    if (points.min(axis=0) < MIN_CAMERA_DISTANCE_M).all() and (points.max(axis=0) > -MIN_CAMERA_DISTANCE_M).all():
        return f"object {item.id!r} contains the camera, expected it to stay clear of the origin"
    if scene.ground.catcher and points[:, 1].max() <= -scene.camera_height:
        return f"object {item.id!r} is below the ground at y = {-scene.camera_height:g}"
    return None


def _surface(item: SceneObject, mesh: GpuMesh) -> Surface | None:
    if item.material is None:
        return None
    r, g, b = item.material.base_color
    return Surface((r, g, b, 1.0), item.material.metallic, item.material.roughness, item.material.emissive,
                   double_sided=any(part.surface.double_sided for part in mesh.parts))

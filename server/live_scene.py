"""The scene of one stream as it stands now. Each change makes a new frozen `Scene` with the next revision."""

from __future__ import annotations

import secrets
from collections import OrderedDict
from collections.abc import Callable
from typing import Any

from renderer.scene import Scene, SceneObject

KEPT_REVISIONS = 256        # more than come while a picture is on its way through the encoder

# (revision's scene, id of the changed object or None when the whole scene was replaced)
SceneChanged = Callable[["LiveScene", str | None], None]


class UnknownObjectError(LookupError):
    """No object of the scene has this id."""


class DuplicateObjectError(ValueError):
    """The id is already in use in the scene."""


class LiveScene:
    """Owner of a stream's scene. Every edit ends in one call of `changed`."""

    def __init__(self, changed: SceneChanged) -> None:
        self.scene = Scene()
        self.revision = 1
        self._changed = changed
        self._recent: OrderedDict[int, Scene] = OrderedDict({self.revision: self.scene})
        # Scenes live in memory: without it a revision of an earlier run would pass for one of this run.
        self._epoch = secrets.token_hex(4)

    @property
    def etag(self) -> str:
        return f'"{self._epoch}-{self.revision}"'

    def as_json(self) -> dict[str, Any]:
        return self.scene.model_dump(mode="json")

    def at(self, revision: int) -> Scene | None:
        """The scene of a recent revision; None when it is older than the last `KEPT_REVISIONS`."""
        return self._recent.get(revision)

    def find(self, object_id: str) -> SceneObject | None:
        return next((placed for placed in self.scene.objects if placed.id == object_id), None)

    def get(self, object_id: str) -> SceneObject:
        """Raises UnknownObjectError."""
        found = self.find(object_id)
        if found is None:
            raise UnknownObjectError(object_id)
        return found

    def replace(self, scene: Scene) -> None:
        self._set(scene, None)

    def add(self, placed: SceneObject) -> None:
        """Raises DuplicateObjectError, or pydantic's ValidationError when the scene is full."""
        if any(placed.id == other.id for other in (*self.scene.objects, *self.scene.local_scene)):
            raise DuplicateObjectError(placed.id)
        self._set_objects((*self.scene.objects, placed), placed.id)

    def update(self, placed: SceneObject) -> None:
        """Put the object in the place of the one with the same id. Raises UnknownObjectError."""
        self.get(placed.id)
        objects = tuple(placed if other.id == placed.id else other for other in self.scene.objects)
        self._set_objects(objects, placed.id)

    def remove(self, object_id: str) -> None:
        """Raises UnknownObjectError."""
        self.get(object_id)
        self._set_objects(tuple(other for other in self.scene.objects if other.id != object_id), object_id)

    def _set_objects(self, objects: tuple[SceneObject, ...], changed_id: str) -> None:
        # The values are valid already and are taken as they are; only the rules of the whole are checked again.
        self._set(Scene.model_validate({**dict(self.scene), "objects": objects}), changed_id)

    def _set(self, scene: Scene, changed_id: str | None) -> None:
        self.scene = scene
        self.revision += 1
        self._recent[self.revision] = scene
        if len(self._recent) > KEPT_REVISIONS:
            self._recent.popitem(last=False)
        self._changed(self, changed_id)

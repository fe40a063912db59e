"""Which objects are near which, and the near field of each; kept until one of them moves."""

from __future__ import annotations

from dataclasses import replace
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from renderer.light.detection import Light
from renderer.models.gpu_mesh import GpuMesh, PlacedMesh
from renderer.models.shapes import Shape, Solid, fitted_shape
from renderer.objects.bounce import bounced
from renderer.objects.near_field import Body, Fit, NearField, mean_albedo, surface_points

Array = NDArray[np.floating]
MAX_BODIES = 1024          # that are remembered
NEIGHBOUR_REACH = 4.0     # in sizes of both together; what is farther away covers less than a hundredth of the view


class Surroundings:
    """Owns the near field of every object in the scene."""

    def __init__(self) -> None:
        self._models: WeakKeyDictionary[GpuMesh, tuple[Shape, Array, Array, Array, float]] = WeakKeyDictionary()
        self._bodies: dict[tuple[int, ...], tuple[PlacedMesh, Body]] = {}     # by what they follow from
        self._kept: dict[str, tuple[bytes, NearField]] = {}
        self._fits: dict[str, Fit] = {}
        self._bounced: dict[str, Array] = {}

    def fits(self, objects: dict[str, PlacedMesh], ground_y: float | None, radiance: NDArray[np.float32],
             irradiance: NDArray[np.float32], lights: tuple[Light, ...]) -> tuple[Fit, ...]:
        """Of each object, for this frame's light: radiance and irradiance maps without `lights`.

        Of those objects whose surroundings have changed one is looked at anew; the others wait for the next frames and take along
        what they had.
        """
        bodies = self.bodies(objects)
        waiting = None
        kept: dict[str, tuple[bytes, NearField]] = {}
        for name in sorted(bodies, key=list(self._kept).index if set(bodies) <= set(self._kept) else lambda _: 0):
            body = bodies[name]
            others = {other: bodies[other] for other in bodies if other != name and _is_near(body, bodies[other])}
            state = b"".join([_state(objects[name]), *(_state(objects[other]) for other in others),
                              repr((ground_y, radiance.shape)).encode()])
            before = self._kept.get(name)
            is_next = before is not None and before[0] != state and waiting is None
            waiting = name if is_next else waiting
            if before is None or is_next:
                before = (state, NearField(body, list(others.values()), ground_y, radiance.shape[0]))
            kept[name] = before
        # the one that was served goes to the end of the queue
        self._kept = {name: kept[name] for name in sorted(kept, key=lambda name: name == waiting)}
        for name in self._due(kept, waiting):
            self._fits[name] = fit = kept[name][1].fit(radiance, irradiance, lights)
            self._bounced[name] = bounced(bodies[name], fit, irradiance, lights, -np.inf if ground_y is None else ground_y)
        return tuple(replace(self._fits[name], centre=bodies[name].solid.centre) for name in objects)

    def _due(self, kept: dict[str, tuple[bytes, NearField]], changed: str | None) -> list[str]:
        """Objects to be fitted to a new light: those that have not been or have changed, and one more in turn; for how an object's
        surroundings dim the light changes less from frame to frame than the light does."""
        self._fits = {name: fit for name, fit in self._fits.items() if name in kept}
        due = [name for name in kept if name not in self._fits or name == changed]
        oldest = next((name for name in self._fits if name not in due), None)
        for name in (*due, oldest):
            if name in self._fits:
                self._fits[name] = self._fits.pop(name)     # to the end of the queue
        return due if oldest is None else [*due, oldest]

    def bounced(self, name: str) -> Array | None:
        """(9, 3) coefficients of the radiance that an object gives back to the ground, as of its last fit."""
        return self._bounced.get(name)

    def reset(self) -> None:
        """The next light has nothing to do with the last one."""
        self._fits.clear()

    def bodies(self, objects: dict[str, PlacedMesh]) -> dict[str, Body]:
        """Each object as its near field sees it."""
        return {name: self.body(item) for name, item in objects.items()}

    def body(self, placed: PlacedMesh) -> Body:
        """One object as its near field sees it, in any pose."""
        key = (id(placed.mesh), id(placed.world_from_model), id(placed.surface))
        if key not in self._bodies:
            if len(self._bodies) > MAX_BODIES:
                self._bodies.clear()
            self._bodies[key] = (placed, self._new_body(placed))    # what is kept with it keeps its ids
        return self._bodies[key][1]

    def _new_body(self, placed: PlacedMesh) -> Body:
        if placed.mesh not in self._models:
            albedo = np.asarray(np.mean([mean_albedo(part.surface) for part in placed.mesh.parts], axis=0))
            metallic = float(np.mean([part.surface.metallic for part in placed.mesh.parts]))
            self._models[placed.mesh] = (fitted_shape(placed.mesh.mesh), *surface_points(placed.mesh.mesh), albedo, metallic)
        shape, points, normals, albedo, metallic = self._models[placed.mesh]
        matrix = placed.world_from_model
        turned = normals @ np.linalg.inv(matrix[:3, :3])
        return Body(Solid.placed(shape, matrix), points @ matrix[:3, :3].T + matrix[:3, 3],
                    turned / np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-12),
                    shape.is_convex, albedo if placed.surface is None else mean_albedo(placed.surface),
                    metallic if placed.surface is None else placed.surface.metallic)


def _state(placed: PlacedMesh) -> bytes:
    # poses are left out: a body's rays start from its points at rest
    return replace(placed, pose_number=0).state()


def _is_near(one: Body, other: Body) -> bool:
    distance = float(np.linalg.norm(one.solid.centre - other.solid.centre))
    return distance < NEIGHBOUR_REACH * (one.solid.radius + other.solid.radius)

"""The scene: what stands in the panorama and how it is lit. The one schema of REST bodies, scene files and stored scenes.

Plain values without any GL, so that the server may import this module (and this one only) of the renderer.
Units and axes: metres, right-handed, +Y up, -Z forward, the panorama camera at the origin, the ground at
`y = -camera_height`. Colours are linear factors, as in glTF.
"""

from __future__ import annotations

import math
import re
from typing import Annotated, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    FiniteFloat,
    ValidationInfo,
    field_validator,
    model_validator,
)

BUILT_IN_MESHES = ("sphere", "box", "cylinder", "teapot")
MAX_OBJECTS = 256
MAX_DISTANCE_M = 10_000.0

Id = Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]{1,64}$")]
Unit = Annotated[float, Field(ge=0.0, le=1.0)]
Coordinate = Annotated[FiniteFloat, Field(ge=-MAX_DISTANCE_M, le=MAX_DISTANCE_M)]
Vector = tuple[Coordinate, Coordinate, Coordinate]


def _unit_quaternion(value: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    length = math.sqrt(sum(component * component for component in value))
    if abs(length - 1.0) > 0.01:
        raise ValueError(f"quaternion length is {length:.6g}, expected 1 (x, y, z, w)")
    x, y, z, w = (component / length for component in value)
    return (x, y, z, w)


def _non_zero_scale(value: tuple[float, float, float]) -> tuple[float, float, float]:
    if any(abs(component) < 1e-6 for component in value):
        raise ValueError(f"scale is {list(value)}, expected no component nearer to 0 than 1e-6")
    return value


Rotation = Annotated[tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat], AfterValidator(_unit_quaternion)]
Scale = Annotated[Vector, AfterValidator(_non_zero_scale)]


class _Value(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Material(_Value):
    """glTF metallic-roughness factors."""

    base_color: tuple[Unit, Unit, Unit] = (0.8, 0.8, 0.8)
    metallic: Unit = 0.0
    roughness: Unit = 0.5
    emissive: tuple[Annotated[float, Field(ge=0, le=1000)], Annotated[float, Field(ge=0, le=1000)],
                    Annotated[float, Field(ge=0, le=1000)]] = (0.0, 0.0, 0.0)


class Animation(_Value):
    clip: Annotated[str, Field(min_length=1, max_length=256)]
    speed: Annotated[float, Field(ge=-100, le=100)] = 1.0
    loop: bool = True


class Placed(_Value):
    """A mesh with its place in the world."""

    id: Id
    mesh: Annotated[str, Field(min_length=1, max_length=4096)]
    position: Vector = (0.0, 0.0, 0.0)
    rotation: Rotation = (0.0, 0.0, 0.0, 1.0)
    scale: Scale = (1.0, 1.0, 1.0)

    @field_validator("mesh")
    @classmethod
    def _known_mesh(cls, value: str, info: ValidationInfo) -> str:
        if value in BUILT_IN_MESHES:
            return value
        if value.startswith("asset:") and len(value) > len("asset:"):
            return value
        if (info.context or {}).get("allow_mesh_paths") and value.lower().endswith((".glb", ".gltf")):
            return value
        raise ValueError(f"unknown mesh {value!r}, expected one of {', '.join(BUILT_IN_MESHES)} or asset:NAME")


class SceneObject(Placed):
    """A virtual object that is seen, lit and casts a shadow. `material: None` keeps the model's own materials."""

    material: Material | None = None
    visible: bool = True
    casts_shadow: bool = True
    animation: Animation | None = None


class LocalSurface(Placed):
    """Real geometry, itself unseen: a `catcher` receives shadows and reflections, an `occluder` hides objects."""

    role: Literal["catcher", "occluder"]


class Ground(_Value):
    catcher: bool = True
    specular: Unit = 0.0
    roughness: Unit = 0.3


STAGES = ("diffuse", "glossy", "lights", "shadows", "composite")
PRESETS = {"default": dict(zip(STAGES, ("auto", "ggx", "default", "area", "ratio"), strict=True)),
           "paper": dict(zip(STAGES, ("map32x16", "rings36", "threshold", "pcf", "additive"), strict=True))}
MAX_GAIN = 1e4


def _diffuse_map(value: str) -> str:
    if value in ("auto", "sh", "convolution"):
        return value
    found = re.fullmatch(r"map(\d{1,3})x(\d{1,3})", value)
    if found is None or not 16 <= int(found[1]) <= 128 or int(found[1]) != 2 * int(found[2]):
        raise ValueError(f"diffuse {value!r}, expected auto, sh, convolution or mapWxH (16x8 to 128x64, twice as wide as high)")
    return value


class Lighting(_Value):
    """The method of each stage: a preset, single stages overridden. `paper`: those of Iorns & Rhee and of MR360.

    `light_count`: of the probe. `threshold`: standard deviations above the mean from which on a light is looked for. `gain`: factor
    for lights that the camera clips, in place of the estimate.
    """

    preset: Literal["default", "paper"] = "default"
    diffuse: Annotated[str, AfterValidator(_diffuse_map)] | None = None
    glossy: Literal["ggx", "rings36"] | None = None
    lights: Literal["default", "threshold", "probe"] | None = None
    light_count: Literal["auto"] | Annotated[int, Field(ge=0, le=64)] | None = None
    threshold: Annotated[float, Field(ge=0.5, le=20.0)] | None = None
    gain: Annotated[float, Field(ge=0.1, le=MAX_GAIN)] | None = None
    shadows: Literal["area", "pcf"] | None = None
    composite: Literal["ratio", "additive"] | None = None

    def method(self, stage: str) -> str:
        """The method in use for one of `STAGES`."""
        chosen: str | None = getattr(self, stage)
        return PRESETS[self.preset][stage] if chosen is None else chosen


class Scene(_Value):
    camera_height: Annotated[float, Field(gt=0.0, le=1000.0)] = 1.6
    ground: Ground = Ground()
    local_scene: Annotated[tuple[LocalSurface, ...], Field(max_length=MAX_OBJECTS)] = ()
    objects: Annotated[tuple[SceneObject, ...], Field(max_length=MAX_OBJECTS)] = ()
    lighting: Lighting = Lighting()

    @model_validator(mode="after")
    def _unique_ids(self) -> Scene:
        seen: set[str] = set()
        for placed in (*self.objects, *self.local_scene):
            if placed.id in seen:
                raise ValueError(f"id {placed.id!r} is used twice, expected unique ids")
            seen.add(placed.id)
        return self

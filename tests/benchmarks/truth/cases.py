"""What is held against the truth: scenes, and the radiance maps they stand in."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from renderer.equirectangular import pixel_directions
from server.worker.images import read_still
from tests.benchmarks.truth.path_tracer import interpolated

Array32 = NDArray[np.float32]
# one map for each kind of light; any others in the folder are left out unless asked for by name
MAPS = {"sun": "o3d_brightday", "hazy": "blender_city", "overcast": "pmndrs_city", "window": "pmndrs_apartment",
        "lamps": "pmndrs_lobby", "studio": "blender_studio", "night": "o3d_nightlights", "sunset": "blender_sunset"}
CAMERA_HEIGHT = 1.6
FLOOR = -CAMERA_HEIGHT
MATERIALS = {
    "diffuse": {"base_color": [0.7, 0.25, 0.2], "metallic": 0.0, "roughness": 1.0},
    "dielectric": {"base_color": [0.2, 0.35, 0.7], "metallic": 0.0, "roughness": 0.35},
    "glossy-metal": {"base_color": [0.95, 0.75, 0.45], "metallic": 1.0, "roughness": 0.25},
    "rough-metal": {"base_color": [0.9, 0.9, 0.9], "metallic": 1.0, "roughness": 0.5},
    "mirror": {"base_color": [0.95, 0.95, 0.95], "metallic": 1.0, "roughness": 0.0},
}


def _object(name: str, mesh: str, position: tuple[float, float, float], scale: tuple[float, float, float], material: str,
            turn: float = 0.0) -> dict[str, Any]:
    rotation = [0.0, float(np.sin(np.radians(turn) / 2)), 0.0, float(np.cos(np.radians(turn) / 2))]
    return {"id": name, "mesh": mesh, "position": list(position), "scale": list(scale), "rotation": rotation,
            "material": MATERIALS[material]}


def scenes(fox: Path | None) -> dict[str, dict[str, Any]]:
    """Scene JSON by name. Objects are named after their material: the errors are listed by it. `fox`: a textured, skinned model."""
    found = {
        "cylinder": [_object("diffuse", "cylinder", (0.4, FLOOR + 0.5, -2.2), (0.6, 1.0, 0.6), "diffuse")],
        "five": [
            _object("diffuse", "teapot", (-1.4, FLOOR, -2.0), (0.7, 0.7, 0.7), "diffuse", 30),
            _object("dielectric", "sphere", (-0.45, FLOOR + 0.35, -2.4), (0.7, 0.7, 0.7), "dielectric"),
            _object("mirror", "sphere", (0.5, FLOOR + 0.4, -2.3), (0.8, 0.8, 0.8), "mirror"),
            _object("glossy-metal", "cylinder", (1.35, FLOOR + 0.45, -2.0), (0.6, 0.9, 0.6), "glossy-metal"),
            _object("rough-metal", "box", (0.1, FLOOR + 0.2, -1.5), (0.4, 0.4, 0.4), "rough-metal", 25),
        ],
        "seam": [_object("dielectric", "box", (0.2, FLOOR + 0.4, 2.0), (0.6, 0.8, 0.6), "dielectric", 20)],
        "below": [_object("diffuse", "sphere", (0.15, FLOOR + 0.3, -0.1), (0.6, 0.6, 0.6), "diffuse")],
    }
    documents = {name: {"camera_height": CAMERA_HEIGHT, "objects": objects} for name, objects in found.items()}
    if fox is not None:
        documents["model"] = {"camera_height": CAMERA_HEIGHT, "objects": [{
            "id": "textured", "mesh": fox.name, "position": [0.3, FLOOR, -2.0], "scale": [0.011, 0.011, 0.011],
            "rotation": [0, 0.38268343, 0, 0.92387953], "animation": {"clip": "Run", "speed": 1.0, "loop": True}}]}
    return documents


def load_map(folder: Path, name: str, width: int) -> Array32:
    """(width / 2, width, 3) radiance, resampled if the file has another size."""
    path = next(iter(sorted(folder.glob(f"{name}.*"), key=lambda p: p.suffix != ".exr")), None)
    if path is None:
        raise ValueError(f"no map {name!r} in {str(folder)!r}, expected a file of that name")
    radiance = read_still(path).rgb
    if radiance.shape[:2] != (width // 2, width):
        shape = zip((width // 2, width), radiance.shape[:2], strict=True)
        rows, columns = ((np.arange(wanted) + 0.5) * given / wanted - 0.5 for wanted, given in shape)
        radiance = interpolated(radiance, rows, columns)
    return np.ascontiguousarray(np.clip(radiance, 0, 6e4), dtype=np.float32)


def traced_region(scene: dict[str, Any], bounds: list[NDArray[np.float64]], width: int) -> NDArray[np.bool_]:
    """(width / 2, width): pixels whose ray passes an object nearby, or meets the floor near it. `bounds`: (2, 3) of each object."""
    directions = pixel_directions(width // 2, width)
    mask = np.zeros((width // 2, width), dtype=bool)
    for low, high in bounds:
        centre, size = (low + high) / 2, float(np.linalg.norm(high - low))
        base = np.array([centre[0], -scene["camera_height"], centre[2]])
        along = directions @ centre
        mask |= (np.linalg.norm(directions * np.maximum(along, 0)[..., None] - centre, axis=-1) < 0.6 * size)
        with np.errstate(divide="ignore"):
            distance = -scene["camera_height"] / directions[..., 1]
        on_floor = directions * distance[..., None] - base
        mask |= (directions[..., 1] < 0) & (np.linalg.norm(on_floor, axis=-1) < 1.4 * size)
    return mask

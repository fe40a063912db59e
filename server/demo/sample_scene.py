"""What stands in the demo's panorama: on the ground, in front of the synthetic camera."""

from __future__ import annotations

from typing import Any

from renderer.scene import Scene
from server.demo.landscape import CAMERA_HEIGHT_M

GROUND_Y = -CAMERA_HEIGHT_M
BOX_EDGE, SPHERE_DIAMETER, TEAPOT_HEIGHT = 0.6, 0.7, 0.6


def sample_scene() -> dict[str, Any]:
    """A teapot 2.7 m ahead, a polished metal sphere to its left and a box to its right, as scene JSON."""
    scene = Scene.model_validate({
        "camera_height": CAMERA_HEIGHT_M,
        "objects": [
            {"id": "teapot", "mesh": "teapot", "position": [0, GROUND_Y, -2.7], "scale": [TEAPOT_HEIGHT] * 3,
             "material": {"base_color": [0.72, 0.09, 0.06], "metallic": 0.0, "roughness": 0.25}},
            {"id": "sphere", "mesh": "sphere", "position": [-1.35, GROUND_Y + SPHERE_DIAMETER / 2, -2.5],
             "scale": [SPHERE_DIAMETER] * 3,
             "material": {"base_color": [0.95, 0.93, 0.88], "metallic": 1.0, "roughness": 0.05}},
            {"id": "box", "mesh": "box", "position": [1.35, GROUND_Y + BOX_EDGE / 2, -2.5], "scale": [BOX_EDGE] * 3,
             "rotation": [0, 0.258819, 0, 0.965926],
             "material": {"base_color": [0.10, 0.28, 0.62], "metallic": 0.0, "roughness": 0.6}},
        ],
    })
    return scene.model_dump(mode="json")

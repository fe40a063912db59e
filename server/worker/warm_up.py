"""Has the driver compile the shaders before the first frame of a stream needs them."""

from __future__ import annotations

from typing import Any

import numpy as np

from renderer.frame import YuvFrame
from renderer.pipeline import Pipeline
from renderer.scene import Scene


def warm_up(pipeline: Pipeline, size: tuple[int, int]) -> None:
    """Run every shader once, so that no frame of the stream waits for the driver's compiler."""
    width, height = size
    grey = YuvFrame(np.full((height, width), 126, np.uint8), *(np.full((height // 2, width // 2), 128, np.uint8),) * 2)
    grey.y[height // 4:height // 4 + max(2, height // 64), :max(2, width // 64)] = 235  # a light, so that it casts a shadow
    objects: list[dict[str, Any]] = [
        {"id": "warm-up-1", "mesh": "box", "position": [0, -1.1, -3], "material": {"roughness": 0.5}},
        {"id": "warm-up-2", "mesh": "sphere", "position": [3, -1.1, 0], "material": {"metallic": 1, "roughness": 0}},
        {"id": "warm-up-3", "mesh": "sphere", "position": [0.7, -1.1, -3], "material": {"roughness": 0.3}}]
    pipeline.render(grey, Scene.model_validate({"objects": objects}))
    pipeline.compile_variants()
    pipeline.render(grey, Scene())
    pipeline.reset()

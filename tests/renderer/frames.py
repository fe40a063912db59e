"""Frames and scenes that several tests use."""

from __future__ import annotations

from typing import Any

from renderer.scene import Scene
from server.bench.frames import direction, noise_frame, sky_with_sun, yuv_from_linear

__all__ = ["direction", "noise_frame", "scene", "sky_with_sun", "yuv_from_linear"]


def scene(*objects: dict[str, Any], **values: Any) -> Scene:
    return Scene.model_validate({"objects": [{"id": f"o{i}", **item} for i, item in enumerate(objects)], **values})

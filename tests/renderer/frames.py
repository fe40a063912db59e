"""Frames and scenes that several tests use."""

from __future__ import annotations

from typing import Any

import numpy as np

from renderer.color import YuvFormat, srgb_from_linear
from renderer.equirectangular import pixel_directions
from renderer.frame import RadianceFrame, YuvFrame
from renderer.scene import Scene


def direction(azimuth_deg: float, elevation_deg: float) -> np.ndarray:
    """Unit vector; azimuth 0 is forward (-Z), positive to the right."""
    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
    return np.array([np.cos(elevation) * np.sin(azimuth), np.sin(elevation), -np.cos(elevation) * np.cos(azimuth)])


def sky_with_sun(azimuth_deg: float, elevation_deg: float, *, size: tuple[int, int] = (512, 256), sky: float = 0.5,
                 sun: float = 400.0, radius_deg: float = 2.0) -> RadianceFrame:
    """Uniform radiance with one disc in it."""
    width, height = size
    inside = pixel_directions(height, width) @ direction(azimuth_deg, elevation_deg) > np.cos(np.radians(radius_deg))
    return RadianceFrame(np.repeat(np.where(inside, sun, sky)[..., None], 3, axis=2).astype(np.float32))


def yuv_from_linear(linear: np.ndarray, layout: YuvFormat | None = None) -> YuvFrame:
    """(height, width, 3) linear display light to 8-bit 4:2:0, chroma taken from every second pixel."""
    layout = layout or YuvFormat()
    matrix = layout.yuv_from_rgb()
    codes = srgb_from_linear(np.clip(linear, 0, 1)) @ matrix[:, :3].T + matrix[:, 3]
    yuv = np.clip(np.round(codes * 255), 0, 255).astype(np.uint8)
    return YuvFrame(yuv[..., 0].copy(), yuv[::2, ::2, 1].copy(), yuv[::2, ::2, 2].copy(), layout)


def noise_frame(size: tuple[int, int], seed: int = 0, layout: YuvFormat | None = None) -> YuvFrame:
    width, height = size
    random = np.random.default_rng(seed)
    planes = [random.integers(0, 256, shape, dtype=np.uint8) for shape in ((height, width), *[(height // 2, width // 2)] * 2)]
    return YuvFrame(planes[0], planes[1], planes[2], layout or YuvFormat())


def scene(*objects: dict[str, Any], **values: Any) -> Scene:
    return Scene.model_validate({"objects": [{"id": f"o{i}", **item} for i, item in enumerate(objects)], **values})

"""Frames and directions of which it is known what is in them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from renderer.color import YuvFormat, linear_from_srgb, srgb_from_linear
from renderer.equirectangular import pixel_directions
from renderer.frame import RadianceFrame, YuvFrame

Array = NDArray[np.float64]


def direction(azimuth_deg: float, elevation_deg: float) -> Array:
    """Unit vector; azimuth 0 is forward (-Z), positive to the right."""
    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
    return np.array([np.cos(elevation) * np.sin(azimuth), np.sin(elevation), -np.cos(elevation) * np.cos(azimuth)])


def sky_with_sun(azimuth_deg: float, elevation_deg: float, *, size: tuple[int, int] = (512, 256), sky: float = 0.5,
                 sun: float = 400.0, radius_deg: float = 2.0) -> RadianceFrame:
    """Uniform radiance with one disc in it."""
    width, height = size
    inside = pixel_directions(height, width) @ direction(azimuth_deg, elevation_deg) > np.cos(np.radians(radius_deg))
    return grey_frame(np.where(inside, sun, sky))


def grey_frame(radiance: NDArray[np.floating]) -> RadianceFrame:
    """Of (height, width) radiance."""
    return RadianceFrame(np.repeat(radiance[..., None], 3, axis=2).astype(np.float32))


def yuv_from_linear(linear: NDArray[np.floating], layout: YuvFormat | None = None) -> YuvFrame:
    """(height, width, 3) linear display light, clipped at white, to 8-bit 4:2:0; chroma is the mean of 2 x 2 pixels."""
    layout = layout or YuvFormat()
    matrix = layout.yuv_from_rgb()
    codes = srgb_from_linear(np.clip(linear, 0.0, 1.0)) @ matrix[:, :3].T + matrix[:, 3]
    height, width = codes.shape[:2]
    chroma = codes[..., 1:].reshape(height // 2, 2, width // 2, 2, 2).mean(axis=(1, 3))
    y, u, v = (np.clip(np.round(255 * plane), 0, 255).astype(np.uint8) for plane in (codes[..., 0], chroma[..., 0], chroma[..., 1]))
    return YuvFrame(y, u, v, layout)


def linear_from_yuv(frame: YuvFrame) -> Array:
    """(height, width, 3) linear display light of a frame's codes; pixels share the chroma of their block."""
    matrix = frame.format.rgb_from_yuv()
    chroma = [plane.repeat(2, axis=0).repeat(2, axis=1) for plane in (frame.u, frame.v)]
    signal = np.stack([frame.y, *chroma], axis=-1) / 255.0 @ matrix[:, :3].T + matrix[:, 3]
    return linear_from_srgb(np.clip(signal, 0.0, 1.0))


def noise_frame(size: tuple[int, int], seed: int = 0, layout: YuvFormat | None = None) -> YuvFrame:
    width, height = size
    random = np.random.default_rng(seed)
    planes = [random.integers(0, 256, shape, dtype=np.uint8) for shape in ((height, width), *[(height // 2, width // 2)] * 2)]
    return YuvFrame(planes[0], planes[1], planes[2], layout or YuvFormat())

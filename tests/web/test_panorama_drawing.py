"""What panorama.js draws, pixel for pixel, against bilinear sampling in numpy."""

from __future__ import annotations

import base64
import io
import math

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from playwright.sync_api import Page

WIDTH, HEIGHT = 2048, 1024
VIEW = 257          # odd: the middle pixel looks straight along the view's axis
FOV = math.radians(70)
TOLERANCE = 4       # 8-bit codes; samplers weigh in steps of 1/256

PREPARE = """
async ([png, size]) => {
  const { Panorama } = await import('/web/panorama.js');
  const camera = await import('/web/camera.js');
  const canvas = new OffscreenCanvas(size, size);
  const panorama = new Panorama(canvas.getContext('webgl2', { alpha: false, antialias: false }));
  const bytes = Uint8Array.from(atob(png), (character) => character.charCodeAt(0));
  panorama.upload(await createImageBitmap(new Blob([bytes]), { colorSpaceConversion: 'none' }));
  window.drawn = (yaw, pitch, fov) => {
    const { width, height } = canvas;
    const projection = camera.perspective(fov, width / height);
    const rays = camera.worldFromScreen(projection, camera.rotationFromYawPitch(yaw, pitch));
    panorama.draw(rays, { x: 0, y: 0, width, height });
    const { gl } = panorama;
    const pixels = new Uint8Array(width * height * 4);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
    let text = '';
    for (let at = 0; at < pixels.length; at += 32768) text += String.fromCharCode(...pixels.subarray(at, at + 32768));
    return btoa(text);
  };
}
"""


@pytest.fixture(scope="module")
def noise(page: Page) -> NDArray[np.uint8]:
    """The panorama that the page draws: noise, so that a shift by a tenth of a pixel shows."""
    pixels = np.random.default_rng(1).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
    png = io.BytesIO()
    Image.fromarray(pixels).save(png, "png")
    page.evaluate(PREPARE, [base64.b64encode(png.getvalue()).decode(), VIEW])
    return pixels


def drawn(page: Page, yaw: float, pitch: float) -> NDArray[np.uint8]:
    text = page.evaluate("([yaw, pitch, fov]) => drawn(yaw, pitch, fov)", [yaw, pitch, FOV])
    return np.frombuffer(base64.b64decode(text), np.uint8).reshape(VIEW, VIEW, 4)[::-1, :, :3]


def uv_of_view(yaw: float, pitch: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Panorama coordinates of every pixel of the view, row 0 is up."""
    offsets = ((np.arange(VIEW) + 0.5) / VIEW * 2 - 1) * math.tan(FOV / 2)
    right, up = np.meshgrid(offsets, -offsets)
    y = up * math.cos(pitch) + math.sin(pitch)
    ahead = math.cos(pitch) - up * math.sin(pitch)
    x = right * math.cos(yaw) + ahead * math.sin(yaw)
    minus_z = ahead * math.cos(yaw) - right * math.sin(yaw)
    return 0.5 + np.arctan2(x, minus_z) / math.tau, np.arctan2(np.hypot(x, minus_z), y) / math.pi


def sampled(panorama: NDArray[np.uint8], u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
    """Bilinear; u wraps, v ends."""
    x, y = u * WIDTH - 0.5, v * HEIGHT - 0.5
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    across, down = (x - left)[..., None], (y - top)[..., None]
    rows = [np.clip(top + i, 0, HEIGHT - 1) for i in (0, 1)]
    upper, lower = ((1 - across) * panorama[row, left % WIDTH] + across * panorama[row, (left + 1) % WIDTH]
                    for row in rows)
    result: NDArray[np.float64] = (1 - down) * upper + down * lower
    return result


@pytest.mark.parametrize(("yaw", "pitch"), [(0, 0), (90, 0), (180, 0), (-179, 30), (-60, -45), (20, 90), (-100, -88)])
def test_every_pixel_is_the_panorama_in_its_direction(page: Page, noise: NDArray[np.uint8], yaw: float,
                                                      pitch: float) -> None:
    view = drawn(page, math.radians(yaw), math.radians(pitch)).astype(float)
    u, v = uv_of_view(math.radians(yaw), math.radians(pitch))
    difference = np.abs(view - sampled(noise, u, v)).max(axis=-1)
    away_from_poles = np.minimum(v, 1 - v) * HEIGHT > 2     # within two rows of a pole u changes faster than float32
    assert difference[away_from_poles].max() <= TOLERANCE
    assert away_from_poles.mean() > 0.99


@pytest.mark.parametrize("yaw", [0.0, 90.0, 137.3, 180.0, -45.0])
def test_the_middle_of_the_view_is_that_pixel_of_the_panorama(page: Page, noise: NDArray[np.uint8], yaw: float) -> None:
    column = round((0.5 + yaw / 360) * WIDTH - 0.5) % WIDTH
    centered = ((column + 0.5) / WIDTH - 0.5) * math.tau
    row = HEIGHT // 2
    middle = drawn(page, centered, math.pi * (0.5 - (row + 0.5) / HEIGHT))[VIEW // 2, VIEW // 2]
    assert np.abs(middle.astype(int) - noise[row, column]).max() <= TOLERANCE

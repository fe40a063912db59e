"""The main promise, seen by a real browser: what REST places, moves and deletes shows, the rest stays as it was."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from browser_page import video_pixels
from numpy.typing import NDArray
from playwright.sync_api import Page
from processes import wait_for
from running_service import Service
from source_picture import SourcePicture, pixel_of

LEFT, RIGHT = (-1.2, -1.0, -2.2), (1.4, -1.0, -2.0)
SEEN_WITHIN_S = 20.0


def check_objects_follow_rest(page: Page, service: Service, clip: Path) -> None:
    """Play /view/live in `page` and place, move and delete an object in the stream `live`, which shows `clip`."""
    source = SourcePicture(clip)
    page.goto(f"{service.url}/view/live")
    pixels = newest_pixels(page)
    assert pixels.shape == source.mean.shape
    everywhere = np.ones(pixels.shape[:2], bool)
    check_background(source, pixels, everywhere)

    service.place(id="ball", mesh="sphere", position=LEFT, scale=[0.9, 0.9, 0.9],
                  material={"base_color": [0.9, 0.02, 0.9], "metallic": 0.0, "roughness": 0.9})
    wait_for("magenta ball on the left", lambda: is_magenta(newest_pixels(page), LEFT), SEEN_WITHIN_S)
    pixels = newest_pixels(page)
    assert not is_magenta(pixels, RIGHT)
    behind = np.abs(np.arange(pixels.shape[1]) / pixels.shape[1] - 0.5) > 0.25
    check_background(source, pixels, everywhere & behind)

    service.request("PATCH", "/api/streams/live/objects/ball", {"position": RIGHT})
    wait_for("magenta ball on the right", lambda: is_magenta(newest_pixels(page), RIGHT), SEEN_WITHIN_S)
    assert not is_magenta(newest_pixels(page), LEFT)

    service.request("DELETE", "/api/streams/live/objects/ball")
    wait_for("ball gone", lambda: not is_magenta(newest_pixels(page), RIGHT), SEEN_WITHIN_S)
    check_background(source, newest_pixels(page), everywhere)


def newest_pixels(page: Page) -> NDArray[np.uint8]:
    def read() -> list[NDArray[np.uint8]]:
        pixels = video_pixels(page)
        return [] if pixels is None else [pixels]

    return wait_for("picture in the browser", read, 60)[0]


def check_background(source: SourcePicture, pixels: NDArray[np.uint8], region: NDArray[np.bool_]) -> None:
    psnr, bias = source.psnr_db(pixels, region), source.bias(pixels, region)
    assert psnr > 30, f"background differs from the source: {psnr:.1f} dB, bias {bias}"
    assert np.abs(bias).max() < 2.5, f"background has a colour cast of {bias} codes, {psnr:.1f} dB"


def is_magenta(pixels: NDArray[np.uint8], position: tuple[float, float, float]) -> bool:
    row, column = pixel_of(position, pixels.shape)
    red, green, blue = np.median(pixels[row - 3:row + 4, column - 3:column + 4].reshape(-1, 3), axis=0)
    return bool(min(red, blue) - green > 40)

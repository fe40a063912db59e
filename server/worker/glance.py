"""A cheap look at each frame: whether its light may be another, without reading it.

Every eighth pixel or so stands for the frame: 256 x 128 codes of luma are taken for radiance by the papers' operator and added up
to the irradiance of the six faces of a cube. What the camera clips is added up a second time by itself, because it may be worth far
more than white: a lamp of a hundred pixels that is switched on is little to the mean of a frame and much to its light.
"""

from __future__ import annotations

from collections import deque
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from renderer.color import linear_from_srgb
from renderer.equirectangular import pixel_directions, solid_angles
from renderer.frame import YuvFrame
from renderer.light.highlights import MAX_LAMP
from renderer.light.inverse_tone_mapping import OFFSET, radiance_from_linear

Floats = NDArray[np.float32]
COLUMNS = 256           # samples of a frame across, at most
CUT_CODES = 12.0        # mean difference of luma, between frames with and without a cut
# Of the irradiance: a smaller change is not seen; what is clipped flickers about white, and is smoothed over seconds anyway.
VISIBLE = np.array([[0.01], [0.05]], dtype=np.float32)
CLIPPED = 0.985         # of the display signal; as in panorama.glsl
NOISE_FRAMES = 30       # over which the median change from one frame to the next is taken for noise,
NOISE_FACTOR = 6.0      # so often exceeded by what is none: four standard deviations


class Seen(NamedTuple):
    """`is_cut`: the frame has little to do with the last one, or is the first. `is_changed`: its light differs visibly from that of
    the frame that was marked last."""

    is_cut: bool
    is_changed: bool


class Glance:
    """Looks at one frame after another. `mark` after a look: the light of that frame has been read."""

    def __init__(self) -> None:
        self._codes: NDArray[np.uint8] | None = None
        self._faces: Floats | None = None
        self._marked: Floats | None = None
        self._steps: deque[Floats] = deque(maxlen=NOISE_FRAMES)

    def look(self, picture: YuvFrame, tolerance: float = 1.0) -> Seen:
        """`tolerance`: of a change, in units of what can just be seen."""
        step = max(1, picture.y.shape[1] // COLUMNS)
        codes = picture.y[step // 2::step, step // 2::step]
        before, self._codes = self._codes, codes.copy()
        faces_before, self._faces = self._faces, _faces(self._codes, picture.format.full_range)
        if before is None or faces_before is None or before.shape != codes.shape or _difference(before, codes) > CUT_CODES:
            self._steps.clear()
            self._marked = None
            return Seen(True, True)
        self._steps.append(_change(faces_before, self._faces))
        return Seen(False, self._marked is None or self._differs(self._marked, self._faces, tolerance))

    def mark(self) -> None:
        self._marked = self._faces

    def _differs(self, before: Floats, now: Floats, tolerance: float) -> bool:
        change = _change(before, now)
        usual = list(self._steps)[:-1]      # this frame is no judge of its own noise
        is_visible = change > tolerance * VISIBLE
        if not usual or not is_visible.any():
            return bool(is_visible.any())
        return bool((is_visible & (change > NOISE_FACTOR * np.median(usual, axis=0))).any())


def _difference(before: NDArray[np.uint8], now: NDArray[np.uint8]) -> float:
    return float(np.abs(before.astype(np.int16) - now).mean())


def _faces(codes: NDArray[np.uint8], full_range: bool) -> Floats:
    """(2, 6) irradiance of the faces of a cube: of the frame as it is shown, and of what the camera has clipped, as the brightest
    lamps that it may be."""
    weights, flat = _weights(*codes.shape), codes.ravel()
    return np.stack([weights @ np.take(table, flat) for table in _values(full_range)])


def _change(before: Floats, now: Floats) -> Floats:
    """(2, 6) relative to the face's own irradiance, or the mean face's where it is darker; of what is clipped, to that with it."""
    whole = np.maximum(np.maximum(before, now), before.mean(axis=1, keepdims=True))
    whole[1] += whole[0]
    return np.asarray(np.abs(now - before) / np.maximum(whole, 1e-6))


@lru_cache(maxsize=2)
def _values(full_range: bool) -> Floats:
    """(2, 256) radiance of a code of luma, and what it may be worth if it is clipped."""
    signal = np.arange(256) / 255 if full_range else (np.arange(256) - 16) / 219
    linear = linear_from_srgb(np.clip(signal, 0.0, 1.0))
    shown = radiance_from_linear(np.repeat(linear[:, None], 3, axis=1))[:, 0]
    return np.stack([shown, np.where(signal >= CLIPPED, MAX_LAMP * OFFSET, 0.0)]).astype(np.float32)


@lru_cache(maxsize=2)
def _weights(height: int, width: int) -> Floats:
    """(6, height x width) solid angle times cosine."""
    directions = pixel_directions(height, width).reshape(-1, 3)
    cosines = np.maximum(np.concatenate([directions, -directions], axis=1), 0.0)
    angles = np.repeat(solid_angles(height, width)[:, 0], width)
    return np.ascontiguousarray((cosines * angles[:, None]).T, dtype=np.float32)

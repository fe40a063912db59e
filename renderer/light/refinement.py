"""Where a small light is inside the texels that show it, and how large: from the moments of the frame's own pixels in these texels.

A texel of the radiance map is 1.4 degrees wide, five times the sun. Its light is not in its centre; first and second moments
give direction and angular radius as if the whole frame had been looked at, for a few dozen texels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

import moderngl
import numpy as np
from numpy.typing import NDArray

from renderer.frame import YuvFrame
from renderer.gl import Context, release_all, set_uniforms
from renderer.light.detection import MIN_ANGULAR_RADIUS, MIN_CONTRIBUTION, Candidate, Found
from renderer.light.inverse_tone_mapping import WEIGHTS
from renderer.light.sources import Grid
from renderer.native.kernels import is_built, texel_moments
from renderer.panorama import PanoramaTextures

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Moments = Callable[[Indices], Array]
CAPACITY = 1024             # texels a frame; a light on a pole covers whole rows
SMALL = np.radians(6.0)     # angular radius; what is larger is known well enough


class MomentStage:
    """Owns the pass that takes the moments of one frame geometry."""

    def __init__(self, context: Context, panorama: PanoramaTextures, map_size: tuple[int, int]) -> None:
        self._panorama, self._map_size = panorama, map_size
        self._by_processor = context.is_software and panorama.kind is YuvFrame and is_built()   # without uploading the frame
        self._program = context.program("moments.vert.glsl", "moments.frag.glsl", panorama.defines)
        self._texels = context.gl.buffer(reserve=4 * CAPACITY)
        self._points = context.gl.vertex_array(self._program, [(self._texels, "1i", "texel")])
        self._texture = context.texture((CAPACITY, 1), 4, "f4")
        self._target = context.gl.framebuffer([self._texture])

    def run(self, texels: Indices) -> Array:
        """(n, 4) for at most CAPACITY texels of the map, by flat index: mean luminance by the tone curve; its moments."""
        frame = self._panorama.frame
        if self._by_processor and isinstance(frame, YuvFrame):
            return texel_moments(frame, self._map_size, texels.astype(np.int32)).astype(np.float64)
        self._texels.write(np.asarray(texels, dtype=np.int32))
        self._panorama.upload()
        self._panorama.bind(self._program)
        set_uniforms(self._program, {"map_size": self._map_size, "capacity": CAPACITY})
        self._target.use()
        self._points.render(moderngl.POINTS, len(texels))
        pixels = np.frombuffer(self._target.read((0, 0, CAPACITY, 1), components=4, dtype="f4"), dtype="f4")
        return pixels.reshape(CAPACITY, 4)[:len(texels)].astype(np.float64)

    def release(self) -> None:
        release_all(self._points, self._texels, self._target, self._texture, self._program)


def refined(found: Found, moments: Moments) -> Found:
    """The same candidates, the small and strong ones with direction and angular radius from the frame's pixels."""
    chosen, count = [], 0
    for index, candidate in enumerate(found.candidates):
        size, is_strong = len(candidate.source.texels), candidate.contribution > 0.5 * MIN_CONTRIBUTION
        if size and is_strong and candidate.light.angular_radius < SMALL and count + size <= CAPACITY:
            chosen.append(index)
            count += size
    if not chosen:
        return found
    texels = np.concatenate([found.candidates[index].source.texels for index in chosen])
    values, candidates, start = moments(texels), list(found.candidates), 0
    for index in chosen:
        end = start + len(candidates[index].source.texels)
        candidates[index] = _refined(found.grid, candidates[index], values[start:end])
        start = end
    return replace(found, candidates=tuple(candidates))


def _refined(grid: Grid, candidate: Candidate, moments: Array) -> Candidate:
    texels = candidate.source.texels
    solid_angle = grid.solid_angle(texels)
    shown, excess = grid.luminance[texels].astype(np.float64), candidate.source.excess @ WEIGHTS
    level = np.maximum(shown - excess, 0.0)
    # per unit of what the texel shows, so that what has been restored is counted like the rest
    first, second = (moments[:, columns] / np.maximum(moments[:, :1], 1e-12) for columns in (slice(1, 3), slice(3, 4)))
    centres, right, down = _frames(grid, texels)
    lit = excess > 0.0
    power = solid_angle * excess
    even_first, even_second = (values[texels // grid.shape[1]] for values in _even_moments(*grid.shape))
    rightwards = solid_angle * lit * shown * first[:, 0]
    downwards = solid_angle * lit * (shown * first[:, 1] - level * even_first)
    shift = rightwards[:, None] * right + downwards[:, None] * down
    vector = power @ centres + shift.sum(axis=0)
    length, total = float(np.linalg.norm(vector)), float(power.sum())
    if length <= 0.0 or total <= 0.0:
        return candidate
    direction = vector / length
    away = centres - direction
    spread = power @ (away**2).sum(axis=1) + 2 * (shift * away).sum()
    spread += (solid_angle * lit) @ (shown * second[:, 0] - level * even_second)
    # the mean squared chord is 2 (1 - R), and a uniform cap of half-angle a has R = (1 + cos a) / 2
    radius = float(np.arccos(np.clip(1 - max(spread / total, 0.0), -1, 1)))
    light = replace(candidate.light, direction=direction, angular_radius=max(radius, MIN_ANGULAR_RADIUS))
    return replace(candidate, light=light)


@lru_cache(maxsize=4)
def _even_moments(height: int, width: int) -> tuple[Array, Array]:
    """(height,) first moment downwards and second moment of an even texel of each row about its centre: near a pole, most of its
    solid angle is on one side."""
    offsets = (np.arange(32) + 0.5) / 32 - 0.5
    theta = (np.arange(height)[:, None] + 0.5 + offsets) * np.pi / height
    weights = np.sin(theta) / np.sin(theta).sum(axis=1, keepdims=True)
    down, across = offsets * np.pi / height, (2 * np.pi / width * np.sin(theta)) ** 2 / 12
    return (weights * down).sum(axis=1), (weights * (down**2 + across)).sum(axis=1)


def _frames(grid: Grid, texels: Indices) -> tuple[Array, Array, Array]:
    """Direction of each texel's centre, and unit vectors to its right and downwards."""
    centres = grid.directions[texels]
    around = np.maximum(np.hypot(centres[:, 0], centres[:, 2]), 1e-12)
    right = np.stack([-centres[:, 2] / around, np.zeros(len(texels)), centres[:, 0] / around], axis=1)
    down = np.stack([centres[:, 1] * centres[:, 0] / around, -around, centres[:, 1] * centres[:, 2] / around], axis=1)
    return centres, right, down

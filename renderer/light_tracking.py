"""Light identity over time: a light keeps its id from frame to frame for as long as it lives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from renderer.inverse_tone_mapping import WEIGHTS
from renderer.light_detection import Light

MAX_STEP = np.radians(15.0)   # a light that jumps further between two frames is another one


class LightTracker:
    """Gives every light the id of the nearest one of the last frame, by angle and log power."""

    def __init__(self) -> None:
        self._last: tuple[Light, ...] = ()
        self._next_id = 1

    def update(self, lights: tuple[Light, ...]) -> tuple[Light, ...]:
        """The same lights with ids."""
        matches = self._match(lights)
        identified = []
        for index, light in enumerate(lights):
            if index in matches:
                identity = self._last[matches[index]].id
            else:
                identity = self._next_id
                self._next_id += 1
            identified.append(replace(light, id=identity))
        self._last = tuple(identified)
        return self._last

    def _match(self, lights: tuple[Light, ...]) -> dict[int, int]:
        if not lights or not self._last:
            return {}
        angle = np.arccos(np.clip([[a.direction @ b.direction for b in self._last] for a in lights], -1, 1))
        power = np.log([[max(a.irradiance @ WEIGHTS, 1e-9) / max(b.irradiance @ WEIGHTS, 1e-9) for b in self._last]
                        for a in lights])
        cost = (angle / MAX_STEP) ** 2 + 0.1 * power**2
        rows, columns = linear_sum_assignment(np.where(angle <= MAX_STEP, cost, 1e6))
        return {int(r): int(c) for r, c in zip(rows, columns, strict=True) if angle[r, c] <= MAX_STEP}

"""Animation clips: key frames to the values of nodes at one moment, as glTF 2.0 defines them (its appendix C)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from renderer.models.hierarchy import Array, Indices, unit_quaternions

Interpolation = Literal["LINEAR", "STEP", "CUBICSPLINE"]
Path = Literal["translation", "rotation", "scale", "weights"]
_NEARLY_PARALLEL = 1 - 1e-9


@dataclass(frozen=True)
class Track:
    """Channels that share their path, key times and interpolation.

    `times` (k,) seconds, increasing; `values` (k, 3, c, w): in-tangent, value and out-tangent of c nodes, or (k, 1, c, w)
    where there are no tangents.
    """

    path: Path
    nodes: Indices
    times: NDArray[np.float32]
    values: NDArray[np.float32]
    interpolation: Interpolation

    def at(self, seconds: float) -> Array:
        """(c, w) values of the nodes; before the first and after the last key, that key's."""
        after = int(np.searchsorted(self.times, seconds, side="right"))
        middle = self.values.shape[1] // 2
        if after == 0 or after == len(self.times):
            return self._rotated(self.values[min(after, len(self.times) - 1), middle].astype(np.float64))
        before = after - 1
        start, end = self.values[before, middle].astype(np.float64), self.values[after, middle].astype(np.float64)
        if self.interpolation == "STEP":
            return self._rotated(start)
        interval = float(self.times[after]) - float(self.times[before])
        t = (seconds - float(self.times[before])) / interval
        if self.interpolation == "CUBICSPLINE":
            leaving, arriving = self.values[before, 2].astype(np.float64), self.values[after, 0].astype(np.float64)
            return self._rotated((2 * t**3 - 3 * t**2 + 1) * start + interval * (t**3 - 2 * t**2 + t) * leaving
                                 + (3 * t**2 - 2 * t**3) * end + interval * (t**3 - t**2) * arriving)
        return slerp(start, end, t) if self.path == "rotation" else start + t * (end - start)

    def _rotated(self, values: Array) -> Array:
        return unit_quaternions(values) if self.path == "rotation" else values


def slerp(start: Array, end: Array, t: float) -> Array:
    """(c, 4) unit quaternions between (c, 4) ones, along the shorter way."""
    start, end = unit_quaternions(start), unit_quaternions(end)
    cosine = np.einsum("ij,ij->i", start, end)[:, None]
    end, cosine = np.where(cosine < 0, -end, end), np.minimum(np.abs(cosine), 1.0)
    angle = np.arccos(cosine)
    sine = np.where(cosine < _NEARLY_PARALLEL, np.sin(angle), 1.0)
    straight = cosine >= _NEARLY_PARALLEL
    a = np.where(straight, 1 - t, np.sin((1 - t) * angle) / sine)
    b = np.where(straight, t, np.sin(t * angle) / sine)
    return unit_quaternions(a * start + b * end)


@dataclass(frozen=True)
class Clip:
    """One animation: its tracks and its length, which is the time of its last key."""

    name: str
    seconds: float
    tracks: tuple[Track, ...]

    def moment(self, seconds: float, loop: bool) -> float:
        """The time within the clip: wrapped where it loops, otherwise no earlier than 0 and no later than its end."""
        if not np.isfinite(seconds):
            raise ValueError(f"clip {self.name!r} at {seconds} s, expected a finite time")
        if loop:
            return seconds % self.seconds if self.seconds > 0 else 0.0
        return min(max(seconds, 0.0), self.seconds)

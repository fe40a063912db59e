"""How much is measured: the same rows from fewer frames, maps and points."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Effort:
    """`size`: of live frames; `still`: of the maps that are compared; `frames`: timed ones of live sequences; `repeats`: of stages
    alone; `normals`, `directions`: at which maps are compared; `pixels`: of each part of the whole picture; `texels`: rows of the
    map that its reference sums over; `clip`: width and rate of the demo's clip, `clip_frames` of it."""

    name: str
    size: tuple[int, int]
    still: tuple[int, int]
    frames: int
    repeats: int
    worlds: tuple[str, ...]
    whole_worlds: tuple[str, ...]
    roughnesses: tuple[float, ...]
    normals: int
    directions: int
    pixels: int
    texels: int
    clip: tuple[int, int]
    clip_frames: int

    @property
    def per_world(self) -> int:
        """Times in each world, so that over all of them a stage is timed `repeats` times."""
        return -(-self.repeats // len(self.worlds))


FULL = Effort("full", (1024, 512), (1024, 512), 200, 200, ("sun", "overcast", "room", "lamps"),
              ("sun", "overcast", "room", "lamps"), (0.2, 0.35, 0.5, 0.8), 500, 200,
              120, 80, (2048, 30), 200)
QUICK = Effort("quick", (1024, 512), (512, 256), 16, 10, ("sun", "room"), ("sun",), (0.25, 0.6), 300, 80, 40, 48, (1024, 15), 12)

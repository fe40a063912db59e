"""Lights over time: stable ids, no flicker, no switching for reasons that are not the light's own.

When the whole frame becomes brighter or darker, so do the lights at once: that is the camera's exposure. A light is born
when it has been seen above the gate for a few frames, and dies when it falls below a lower one; both fade, by moving energy
between the light and the residual, so that their sum is the map's in every frame. One that has vanished from the map is gone
at once: there is no energy left to fade. A sun that was never in the map fades by itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from renderer.light.detection import MAX_LIGHTS, MIN_CONTRIBUTION, NOTHING, Candidate, Detection, Found, Light
from renderer.light.inverse_tone_mapping import WEIGHTS
from renderer.light.sources import Source

Array = NDArray[np.float64]
Floats = NDArray[np.floating]
MAX_STEP = np.radians(15.0)   # a light that jumps further between two frames is another one
BIRTH_FRAMES = 3              # above the gate, before a light is believed
DEATH_CONTRIBUTION = 0.4 * MIN_CONTRIBUTION
FADE_S = 0.25
SMOOTHING_S = 0.3             # time constant of power and, for small changes, of direction
CLIPPED_SMOOTHING_S = 3.0     # of the power of lights that the camera clips
FOLLOW_ANGLE = np.radians(0.25)   # a change of direction that is motion and not noise
DEFAULT_STEP_S = 1 / 30
EXPOSURE_STEP = 13             # texels; prime to the row length, so that the samples spread
EXPOSED_ALIKE = 0.15           # of ln exposure: within it, what comes and goes are lights
SUDDEN = 0.12                  # of ln exposure from one frame to the next: no camera's control is that fast
HOLD_S = 10.0                  # after which another exposure is the usual one


@dataclass
class _Track:
    id: int
    light: Light                # smoothed
    source: Source              # in the newest frame
    seen: int = 1               # frames in a row
    presence: float = 0.0       # 0: all of it is in the residual, 1: none
    dying: bool = False

    @property
    def is_settled(self) -> bool:
        return self.presence == 1.0 and not self.dying


class LightTracker:
    """Feed it every frame's candidates. `reset` at a cut."""

    def __init__(self) -> None:
        self._tracks: list[_Track] = []
        self._next_id = 1
        self._moment: float | None = None
        self._is_new = True
        self._luminance: Floats | None = None
        self._exposure = 0.0            # ln, since the lights were last found under a steady one
        self._held_s = 0.0

    def reset(self) -> None:
        """The next frame has nothing to do with the last one: its lights are there at once."""
        self._tracks = []
        self._is_new = True
        self._moment = self._luminance = None
        self._exposure = self._held_s = 0.0

    def update(self, found: Found, moment: float | None = None) -> Detection:
        """Lights and residual of a frame shown at `moment` seconds (None: a thirtieth of a second after the last one)."""
        step = self._step(moment)
        is_held = self._expose(found, step)
        matches = self._match(found.candidates)
        survivors = []
        for index, track in enumerate(self._tracks):
            candidate = found.candidates[matches[index]] if index in matches else found.again(track.source)
            if candidate is not None and (is_held or index in matches or candidate.contribution > DEATH_CONTRIBUTION):
                self._follow(track, candidate, step, is_held)
                survivors.append(track)
            elif is_held:
                survivors.append(replace(track, source=NOTHING))
            elif not len(track.source.texels):      # on top of the map, like the sun of a clipped sky: its power can fade
                survivors.append(replace(track, dying=True, presence=track.presence - step / FADE_S))
        taken = set(matches.values())
        new = [candidate for index, candidate in enumerate(found.candidates)
               if index not in taken and candidate.contribution > MIN_CONTRIBUTION and not is_held]
        # a light that is there keeps its place: where there are too many, the choice must not change from frame to frame
        survivors += [self._begin(candidate) for candidate in new[:MAX_LIGHTS - len(survivors)]]
        self._tracks = [track for track in survivors if track.presence > 0.0 or not track.dying]
        self._is_new = False
        return self._detection(found)

    def _step(self, moment: float | None) -> float:
        before, self._moment = self._moment, moment
        if moment is None or before is None:
            return DEFAULT_STEP_S
        return float(np.clip(moment - before, 0.0, 1.0))

    def _expose(self, found: Found, step: float) -> bool:
        """Scale all tracks by the change of exposure: the median over the frame, which no lamp can move.

        True while the camera exposes otherwise than when the lights were found: then regions clip and unclip, join and part, and
        nothing is born and nothing dies, unless it stays so.
        """
        luminance = found.grid.luminance[::EXPOSURE_STEP]
        before, self._luminance = self._luminance, luminance
        if before is None or before.shape != luminance.shape:
            return False
        known = (before > 0.0) & (luminance > 0.0)
        change = float(np.median(luminance[known] / before[known])) if known.any() else 1.0
        for track in self._tracks:
            track.light = replace(track.light, irradiance=track.light.irradiance * change)
        self._exposure += float(np.log(max(change, 1e-6)))
        is_other = abs(self._exposure) > EXPOSED_ALIKE
        self._held_s = self._held_s + step if is_other else 0.0
        if abs(np.log(max(change, 1e-6))) > SUDDEN or self._held_s > HOLD_S:
            self._exposure = self._held_s = 0.0
            return False
        return is_other

    def _begin(self, candidate: Candidate) -> _Track:
        track = _Track(self._next_id, replace(candidate.light, id=self._next_id), candidate.source)
        self._next_id += 1
        if self._is_new:
            track.presence, track.seen = 1.0, BIRTH_FRAMES
        return track

    def _follow(self, track: _Track, candidate: Candidate, step: float, is_held: bool) -> None:
        now, before = candidate.light, track.light
        slow = 1.0 - np.exp(-step / SMOOTHING_S)
        angle = float(np.arccos(np.clip(now.direction @ before.direction, -1, 1)))
        direction = before.direction + max(slow, min(1.0, angle / FOLLOW_ANGLE)) * (now.direction - before.direction)
        change = np.log(np.maximum(now.irradiance, 1e-12) / np.maximum(before.irradiance, 1e-12))
        # what is clipped tells nothing of its power; when the exposure drops, it unclips and only seems to grow
        rate = 0.0 if is_held else 1.0 - np.exp(-step / (CLIPPED_SMOOTHING_S if candidate.is_clipped else SMOOTHING_S))
        track.light = Light(direction / np.linalg.norm(direction), before.irradiance * np.exp(rate * change),
                            before.angular_radius + slow * (now.angular_radius - before.angular_radius), track.id,
                            before.gain * (now.gain / before.gain) ** rate)
        track.source = candidate.source
        track.seen += 1
        track.dying = not is_held and candidate.contribution < (DEATH_CONTRIBUTION if track.presence > 0 else MIN_CONTRIBUTION)
        if track.dying:
            track.presence -= step / FADE_S
        elif track.seen >= BIRTH_FRAMES:
            track.presence = min(1.0, track.presence + step / FADE_S)

    def _match(self, candidates: tuple[Candidate, ...]) -> dict[int, int]:
        """Which track is which candidate: the nearest by angle and log power."""
        if not candidates or not self._tracks:
            return {}
        before, now = [track.light for track in self._tracks], [candidate.light for candidate in candidates]
        angle = _angles(before, now)
        logs = [np.log(np.maximum(np.array([light.irradiance for light in lights]) @ WEIGHTS, 1e-9)) for lights in (before, now)]
        power = logs[0][:, None] - logs[1][None, :]
        cost = (angle / MAX_STEP) ** 2 + 0.1 * power**2
        rows, columns = linear_sum_assignment(np.where(angle <= MAX_STEP, cost, 1e6))
        return {int(r): int(c) for r, c in zip(rows, columns, strict=True) if angle[r, c] <= MAX_STEP}

    def _detection(self, found: Found) -> Detection:
        kept = sorted((track for track in self._tracks if track.presence > 0.0),
                      key=lambda track: -float(track.presence * track.light.irradiance @ WEIGHTS))[:MAX_LIGHTS]
        detection = found.detection([(replace(track.light, irradiance=track.presence * track.light.irradiance), track.source,
                                      track.presence) for track in kept])
        return replace(detection, is_settled=all(track.is_settled for track in self._tracks))


class LightNames:
    """Ids for lights of methods that know nothing of time: a light has the id of the nearest one in the frame before."""

    def __init__(self) -> None:
        self._before: tuple[Light, ...] = ()
        self._next_id = 1

    def named(self, lights: tuple[Light, ...]) -> tuple[Light, ...]:
        names: dict[int, int] = {}
        if self._before and lights:
            angle = _angles(self._before, lights)
            rows, columns = linear_sum_assignment(np.minimum(angle, MAX_STEP))
            names = {int(c): self._before[r].id for r, c in zip(rows, columns, strict=True) if angle[r, c] < MAX_STEP}
        found = []
        for index, light in enumerate(lights):
            found.append(replace(light, id=names.get(index, self._next_id)))
            self._next_id += index not in names
        self._before = tuple(found)
        return self._before


def _angles(before: Sequence[Light], now: Sequence[Light]) -> Array:
    cosines = np.array([light.direction for light in before]) @ np.array([light.direction for light in now]).T
    return np.asarray(np.arccos(np.clip(cosines, -1, 1)))

"""Keeps the light that live frames are lit by up to date: reads it when it is needed and when there is time.

Needed: with a light subscriber for every frame; without one when the error of the light in use would be seen (`light_need.py`),
when a glance at the frame finds another light (`glance.py`), and frame by frame while a light is being born or dies. When there
is time says `light_schedule.py`. After a cut the old light would be seen for a frame, so the new one is read first.
"""

from __future__ import annotations

from collections import deque

from renderer.frame import YuvFrame
from renderer.light.reading import FrameLight
from renderer.pipeline import Pipeline
from renderer.scene import Lighting
from renderer.timings import Timings
from server.worker.accuracy import Costs, Situation, at_full_effort
from server.worker.glance import Glance
from server.worker.light_need import LightNeed
from server.worker.light_schedule import FINISH, PREPARE, READ, SMOOTHING, LightSchedule

BOTH_STEPS_SLACK = 0.4      # of the time between two frames must be left to take both steps towards the next light in one
NOTICED = 3                 # readings after a glance has found another light: enough for a birth
MOVING_S = 0.1              # between two readings while objects move by themselves: the near field of each follows its light
COUNTED = 300               # frames, for the mean interval
PARTS = ("glossy", "shadows", "objects_and_composite")      # stages of preparing


class LightFollower:
    """Owns the light in use and the next one. `look` at a frame before it is composited, `follow` after; `width` is its own, in
    pixels."""

    def __init__(self, pipeline: Pipeline, width: int, schedule: LightSchedule | None = None) -> None:
        self._pipeline = pipeline
        self._schedule = LightSchedule() if schedule is None else schedule
        self._glance, self.need = Glance(), LightNeed(width)
        self._next: FrameLight | None = None    # read, but not prepared yet
        self._noticed = 0                       # readings that are still wanted since the glance
        self._read_at = 0.0                     # moment of the last one
        self.tolerance = 1.0                    # error of the light in use, in units of what can just be seen
        self._parts_s: dict[str, float] = {}    # of preparing, by stage, smoothed
        self._counted: deque[bool] = deque(maxlen=COUNTED)
        self.light: FrameLight | None = None    # that frames are lit by

    def look(self, picture: YuvFrame) -> None:
        """Glance at a frame that is about to be composited. After a cut there is no light until it is read."""
        seen = self._glance.look(picture, self.tolerance)
        self._counted.append(False)
        if seen.is_cut:
            self._pipeline.reset()
            self.light = self._next = None
            self.disturb()
        elif seen.is_changed:
            self._noticed = NOTICED

    def disturb(self) -> None:
        """The scene is another: what follows from the light is to be found anew, in turn, one reading after another."""
        self.need.reset()

    def take(self, light: FrameLight, moment: float) -> None:
        """Frames are lit by the light of the frame that was looked at last and is shown at that moment."""
        self.light, self._next = light, None
        self._learn(light, moment)

    def _learn(self, light: FrameLight, moment: float) -> None:
        self._glance.mark()
        self.need.learn(light, moment, self.tolerance)
        self._noticed = max(0, self._noticed - 1)
        self._read_at = moment
        if self._counted:
            self._counted[-1] = True

    def follow(self, moment: float, interval_s: float, lighting: Lighting, *,
               every_frame: bool) -> tuple[FrameLight | None, dict[str, float]]:
        """Read the light of the frame that has just been composited, as far as it is needed and there is time before the next one,
        which comes `interval_s` after `moment`. Returns the light if it has been read, and the stages' times in milliseconds."""
        found, stages = None, {}
        due_at = moment + interval_s
        needed = self._next is None and (every_frame or self._is_needed(moment, interval_s))
        if needed and self._schedule.has_time(READ, due_at):
            self._next, timings = self._pipeline.read_light(moment, lighting)
            found, stages = self._next, self._timed(READ, timings)
            self._learn(self._next, moment)
            due_at -= BOTH_STEPS_SLACK * interval_s
        if self._next is not None:
            if self._schedule.has_time(PREPARE, due_at):
                prepared = self._pipeline.prepare(self._next)
                stages |= self._timed(PREPARE, prepared)
                self._measure(prepared)
                self.light, self._next = self._next, None
        elif not needed and self.light is not None and self._pipeline.is_behind and self._schedule.has_time(FINISH, due_at):
            stages = self._timed(FINISH, self._pipeline.prepare(self.light))
        return found, stages

    def _timed(self, step: str, timings: Timings) -> dict[str, float]:
        self._schedule.took(step, timings.total / 1e3)
        return timings.stages

    def _measure(self, prepared: Timings) -> None:
        for stage in PARTS:
            before, now = self._parts_s.get(stage), prepared.stages.get(stage, 0.0) / 1e3
            self._parts_s[stage] = now if before is None else before + SMOOTHING * (now - before)

    def situation(self, interval_s: float) -> Situation:
        """What the light costs and how fast it changes; `interval_s` is the source's."""
        measured = Costs(0.0, self._schedule.cost_s(READ), *(self._parts_s.get(stage, 0.0) for stage in PARTS))
        return Situation(interval_s, at_full_effort(measured, self._pipeline.quality), self.need.rate, self.need.ground_shares)

    def _is_needed(self, moment: float, interval_s: float) -> bool:
        if self.light is None or self._noticed > 0 or not self.light.detection.is_settled:
            return True
        placement = self._pipeline.placement
        longest = MOVING_S if placement is not None and placement.moving else float("inf")
        # half a frame early rather than half a frame late
        return moment + 0.5 * interval_s - self._read_at >= min(self.need.interval_s(self.tolerance), longest)

    @property
    def mean_interval(self) -> float:
        """Frames a reading, of the last ones."""
        return len(self._counted) / max(sum(self._counted), 1)

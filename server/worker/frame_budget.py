"""Keeps the frame rate under load: gives up the cheapest accuracy first, and takes it back when there is room.

Load is the main thread's time for a frame, with the light at the rate that it is asked for, by the time between two frames. Above
the high mark, or when frames are lost for lack of time, the next reductions are those that err least for what they save, by the
model of `accuracy.py`. The last one is undone when the load that is predicted without it stays below the low mark for a while;
the while doubles each time that this proves wrong. Frames are given up last, and only when as many would be lost anyway.
"""

from __future__ import annotations

from collections import deque
from typing import Any, NamedTuple

from server.worker.accuracy import (
    FRAME_STEP,
    FULL_EFFORT,
    LEVERS,
    Lever,
    Situation,
    predicted_cost_s,
    predicted_error,
)

HIGH, LOW = 0.9, 0.8            # marks of the load
TARGET = 0.8                    # that reductions are taken for, all at once
HOPELESS = 1.8                  # of load, with all else given up: every second frame would be lost anyway, and less evenly
JUDGED_FRAMES, ROOM_FRAMES = 15, 30     # since the last decision, before anything is given up or taken back
FIRST_FRAMES = 60                       # that say nothing: models are loaded, all is new
LOST_FRAMES, LOST_WITHIN_S = 3, 5.0     # moments at which frames were lost that count as lack of time: one stall is no load
MIN_SAVING = 0.01               # of the time between two frames
HOLD_S, MOST_HOLD_S = 2.0, 32.0
SMOOTHING = 0.1                 # of the time that a frame takes, where parts are compared with the whole
WRONG_S = 10.0                  # after undoing: giving up again within this time proves it wrong
REMEMBERED = 10                 # decisions


class Decision(NamedTuple):
    """`moment` in seconds of the caller's clock. `lever` went to `value`; why."""

    moment: float
    lever: str
    value: float
    reason: str


class FrameBudget:
    """Fed after each frame that was rendered. `effort` is what the next one is to be given."""

    def __init__(self) -> None:
        self._taken: list[Lever] = []
        self._loads: deque[float] = deque(maxlen=ROOM_FRAMES)
        self._ignored = FIRST_FRAMES
        self._lost_at: deque[float] = deque(maxlen=LOST_FRAMES)
        self._lost = 0
        self._render_s: float | None = None
        self._room_since: float | None = None
        self._undone_at = -float("inf")
        self._hold_s = HOLD_S
        self._decisions: deque[Decision] = deque(maxlen=REMEMBERED)
        self._count = 0
        self.effort = FULL_EFFORT
        self.report: dict[str, Any] = self._reported(None, 0.0, 0.0)

    def feed(self, moment: float, render_s: float, lost: int, situation: Situation) -> bool:
        """A frame was composited in that time; `lost`: frames so far for which there was none; what compositing costs is known from
        `render_s`. True when the effort is another."""
        self._render_s = render_s if self._render_s is None else self._render_s + SMOOTHING * (render_s - self._render_s)
        situation = situation._replace(costs=situation.costs._replace(render=self._render_s))
        interval_s = situation.interval_s * self.effort.frame_step
        light_s = predicted_cost_s(self.effort, situation) - situation.costs.render
        if self._ignored > 0:
            self._ignored -= 1
            self._lost = lost
            return False
        self._loads.append((render_s + light_s) / interval_s)
        if lost > self._lost:
            self._lost_at.append(moment)
        self._lost = lost
        before, taken, load = self.effort, list(self._taken), self._load(JUDGED_FRAMES)
        reason = self._overload(moment, load) if len(self._loads) >= JUDGED_FRAMES else ""
        if reason:
            self._give_up(moment, load, situation)
        elif len(self._loads) >= ROOM_FRAMES and self._taken:
            reason = self._take_back(moment, self._load(ROOM_FRAMES), situation)
        if self.effort != before:
            self._remember(taken, moment, reason)
            self._loads.clear()
            self._lost_at.clear()
            self._room_since = None
        self.report = self._reported(situation, load, moment)
        return self.effort != before

    def rest(self) -> None:
        """Nothing is composited for a while."""
        self._ignored = FIRST_FRAMES
        self._loads.clear()
        self._lost_at.clear()
        self._room_since = None

    def _load(self, frames: int) -> float:
        """The mean of so many frames, without the slowest tenth: one frame may wait, and a stall is no load."""
        newest = sorted(list(self._loads)[-frames:])
        usual = newest[:len(newest) - len(newest) // 10]
        return sum(usual) / len(usual)

    def _is_hopeless(self) -> bool:
        return len(self._loads) == ROOM_FRAMES and sorted(self._loads)[ROOM_FRAMES // 2] > HOPELESS

    def _overload(self, moment: float, load: float) -> str:
        """The reason to give something up, or none."""
        if load > HIGH:
            return f"load {load:.2f}"
        if len(self._lost_at) == LOST_FRAMES and moment - self._lost_at[0] < LOST_WITHIN_S:
            return f"frames lost at load {load:.2f}"
        return ""

    def _give_up(self, moment: float, load: float, situation: Situation) -> None:
        """As much as is needed by the prediction, at least one thing, if there is anything that helps."""
        cost = predicted_cost_s(self.effort, situation)
        taken = 0
        while taken == 0 or load * predicted_cost_s(self.effort, situation) / max(cost, 1e-9) > TARGET:
            chosen = self._cheapest(situation)
            if chosen is None:
                break
            self._step(chosen, 1)
            taken += 1
            self._drop_useless(situation)
        if taken == 0 and self._is_hopeless() and FRAME_STEP not in self._taken:
            self._step(FRAME_STEP, 1)
            taken = 1
        if taken and moment - self._undone_at < WRONG_S:
            self._hold_s = min(2 * self._hold_s, MOST_HOLD_S)
            self._undone_at = -float("inf")

    def _drop_useless(self, situation: Situation) -> None:
        """Take back what saves nothing any more beside what has been given up since."""
        for lever in dict.fromkeys(reversed(self._taken)):
            effort = lever.set(self.effort, self._taken.count(lever) - 1)
            if predicted_cost_s(effort, situation) <= predicted_cost_s(self.effort, situation):
                self._step(lever, -1)

    def _cheapest(self, situation: Situation) -> Lever | None:
        """The next step down that errs least for what it saves."""
        cost, error = predicted_cost_s(self.effort, situation), predicted_error(self.effort, situation)
        found: list[tuple[float, int]] = []
        for index, lever in enumerate(LEVERS):
            step = self._taken.count(lever) + 1
            if step == len(lever.values):
                continue
            effort = lever.set(self.effort, step)
            saving = cost - predicted_cost_s(effort, situation)
            if saving > MIN_SAVING * situation.interval_s:
                found.append(((predicted_error(effort, situation) - error) / saving, index))
        return LEVERS[min(found)[1]] if found else None

    def _take_back(self, moment: float, load: float, situation: Situation) -> str:
        """The last one, if there has been room for it for long enough. Returns why."""
        if self._undone_at + WRONG_S < moment and self._undone_at > -float("inf"):
            self._hold_s, self._undone_at = max(HOLD_S, self._hold_s / 2), -float("inf")    # that was right
        last = self._taken[-1]
        effort = last.set(self.effort, self._taken.count(last) - 1)
        now_s = predicted_cost_s(self.effort, situation) / self.effort.frame_step
        then = load * predicted_cost_s(effort, situation) / effort.frame_step / max(now_s, 1e-9)
        if then > LOW:
            self._room_since = None
            return ""
        self._room_since = moment if self._room_since is None else self._room_since
        if moment - self._room_since >= self._hold_s:
            self._step(last, -1)
            self._undone_at = moment
        return f"load {load:.2f}, without it {then:.2f}"

    def _step(self, lever: Lever, change: int) -> None:
        if change > 0:
            self._taken.append(lever)
        else:
            del self._taken[len(self._taken) - 1 - self._taken[::-1].index(lever)]
        self.effort = lever.set(self.effort, self._taken.count(lever))

    def _remember(self, before: list[Lever], moment: float, reason: str) -> None:
        """What is another than before: one decision for each lever, however far it went."""
        for lever in (*LEVERS, FRAME_STEP):
            step = self._taken.count(lever)
            if step != before.count(lever):
                self._decisions.append(Decision(moment, lever.name, lever.values[step], reason))
                self._count += 1

    def _reported(self, situation: Situation | None, load: float, moment: float) -> dict[str, Any]:
        """What `stats` tells."""
        settings = {lever.name: lever.values[self._taken.count(lever)] for lever in self._taken}
        error = 0.0 if situation is None else predicted_error(self.effort, situation)
        return {"level": len(self._taken), "reductions": list(settings), "settings": settings, "predicted_error": round(error, 5),
                "load": round(load, 3), "decisions": self._count, "hold_s": self._hold_s,
                "last_decisions": [{"seconds_ago": round(moment - item.moment, 2), "lever": item.lever, "value": item.value,
                                    "reason": item.reason} for item in self._decisions]}

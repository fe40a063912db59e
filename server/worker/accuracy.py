"""How accurate a stream's frames are asked to be, and what each step down saves and errs: the model of the frame budget.

Errors are relative to the radiance of what is drawn. What is shown in an older light errs by how fast the light changes at present
(`light_need.py`), which in a still scene is nothing, times how old it is. `python -m server.bench.quality` measures what is
predicted here: the factors below are its results on the demo's clip.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

from renderer.quality import FULL, Quality
from server.worker.light_need import LONGEST_S, VISIBLE

STALE = 0.05                # mean error of all that is drawn, by that of a light in use
STALE_OBJECTS, STALE_LOBES = 0.006, 0.001   # what objects, and glossy light, have of it
COARSE_SHADOWS = 0.0012     # of shadow maps with half the texels a side
# Shares of these stages that follow from the number of lobes, of texels and samples, of pixels.
LOBES_OF_GLOSSY, DETAIL_OF_SHADOWS, PIXELS_OF_OBJECTS = 0.25, 0.5, 0.5
MOST_ERROR = 1.0


@dataclass(frozen=True)
class Effort:
    """`quality` of the renderer; `light_tolerance`, the error of the light in use in units of what can just be seen, which says how
    often it is read; `frame_step`, of so many frames one is rendered."""

    quality: Quality = FULL
    light_tolerance: float = 1.0
    frame_step: int = 1


FULL_EFFORT = Effort()


class Costs(NamedTuple):
    """Seconds at full effort: compositing a frame; reading a light; of preparing it the glossy light, the shadows, the objects."""

    render: float = 0.0
    read: float = 0.0
    glossy: float = 0.0
    shadows: float = 0.0
    objects: float = 0.0


class Situation(NamedTuple):
    """Seconds between two frames of the source; costs; by how much of what can be seen the light changes in a second; the share of
    the ground's irradiance that each light has."""

    interval_s: float
    costs: Costs
    rate: float = 0.0
    ground_shares: tuple[float, ...] = ()


@dataclass(frozen=True)
class Lever:
    """What can be given up, in these steps. The first value is that of full effort."""

    name: str
    values: tuple[float, ...]

    def set(self, effort: Effort, step: int) -> Effort:
        value = self.values[step]
        if self.name == "light_interval":
            return replace(effort, light_tolerance=value)
        if self.name == "frame_step":
            return replace(effort, frame_step=int(value))
        return replace(effort, quality=replace(effort.quality, **{self.name: value}))


LEVERS = (Lever("light_interval", (1.0, 2.0, 4.0, 8.0, 16.0)), Lever("shading_share", (FULL.shading_share, 0.25, 0.15)),
          Lever("lobe_share", (FULL.lobe_share, 0.25)), Lever("shadow_detail", (FULL.shadow_detail, 0.7, 0.5)),
          Lever("min_ground_share", (FULL.min_ground_share, 0.05, 0.1)))
FRAME_STEP = Lever("frame_step", (1, 2))


def readings(effort: Effort, situation: Situation) -> float:
    """Of the light, a frame that is rendered."""
    needed_s = min(effort.light_tolerance / max(situation.rate, 1e-9), LONGEST_S)
    return min(1.0, situation.interval_s * effort.frame_step / needed_s)


def at_full_effort(measured: Costs, quality: Quality) -> Costs:
    """Costs of steps that were measured at this quality."""
    lobes, shadows, objects = _shares(quality)
    return measured._replace(glossy=measured.glossy / lobes, shadows=measured.shadows / shadows, objects=measured.objects / objects)


def predicted_cost_s(effort: Effort, situation: Situation) -> float:
    """Seconds of the main thread for a frame that is rendered, light included."""
    costs, quality, a_frame = situation.costs, effort.quality, readings(effort, situation)
    lobes, shadows, objects = _shares(quality)
    shadows *= 1 - _given_up(effort, situation)[1]
    turns = min(1.0, a_frame / quality.shading_share)       # at objects, a frame
    return (costs.render + a_frame * (costs.read + costs.glossy * lobes + costs.shadows * shadows)
            + turns * costs.objects * objects)


def _shares(quality: Quality) -> tuple[float, float, float]:
    """Of the work on glossy light, on shadows, and on objects in one turn, at full effort."""
    return (1 - LOBES_OF_GLOSSY * (1 - quality.lobe_share / FULL.lobe_share),
            1 - DETAIL_OF_SHADOWS * (1 - quality.shadow_detail),
            1 - PIXELS_OF_OBJECTS * (1 - quality.shading_share / FULL.shading_share))


def predicted_error(effort: Effort, situation: Situation) -> float:
    """More than at full effort, 0 to 1."""
    return min(max(_error(effort, situation) - _error(FULL_EFFORT, situation), 0.0), MOST_ERROR)


def _error(effort: Effort, situation: Situation) -> float:
    quality = effort.quality
    a_second = VISIBLE * situation.rate * situation.interval_s * effort.frame_step     # by which the light is off, a frame of age
    age = 1 / readings(effort, situation)
    objects_age = max(1 / quality.shading_share, age)
    stale = STALE * age + STALE_OBJECTS * (objects_age - age) + STALE_LOBES * age * (1 / quality.lobe_share - 1)
    coarse = COARSE_SHADOWS * (1 / quality.shadow_detail - 1)
    return a_second * stale + coarse + _given_up(effort, situation)[0] + (effort.frame_step - 1) * MOST_ERROR


def _given_up(effort: Effort, situation: Situation) -> tuple[float, float]:
    """By lights that cast no shadow any more: irradiance of the ground in these shadows, share of the work on shadows."""
    casting = [share for share in situation.ground_shares if share > FULL.min_ground_share]
    weak = [share for share in casting if share <= effort.quality.min_ground_share]
    return sum(weak), len(weak) / max(len(casting), 1)

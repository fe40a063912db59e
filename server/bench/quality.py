"""What each reduction of the frame budget saves and errs: `python -m server.bench.quality [--frames N] [--width W]`.

The demo's clip, whose sun goes round in half a minute, and its scene: live frames, lit by the light of an earlier one, against the
same frames lit by their own. The error is the mean difference of linear luma over the pixels that either has touched, relative to
their mean; time is the processor's, of reading, preparing and compositing together. The model of `server/worker/accuracy.py` stands
beside both.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

from renderer.color import linear_from_srgb
from renderer.frame import YuvFrame
from renderer.gl import Context
from renderer.pipeline import Pipeline
from renderer.quality import Quality
from renderer.scene import Scene
from server.bench.stages import five_objects
from server.demo.clip import demo_clip
from server.worker.accuracy import FULL_EFFORT, Costs, Effort, Situation, predicted_cost_s, predicted_error
from server.worker.light_need import LightNeed
from server.worker.picture import PictureReader
from server.worker.warm_up import warm_up

FPS, WARM_UP = 30, 30
LINEAR = linear_from_srgb(np.clip((np.arange(256) - 16) / 219, 0, 1))
Luma = NDArray[np.uint8]
VARIANTS: dict[str, tuple[Quality, int]] = {     # and frames a reading
    "full": (Quality(), 1), "light_interval 2": (Quality(), 2), "light_interval 4": (Quality(), 4),
    "light_interval 8": (Quality(), 8), "shading_share 0.25": (Quality(shading_share=0.25), 1),
    "shading_share 0.15": (Quality(shading_share=0.15), 1), "lobe_share 0.25": (Quality(lobe_share=0.25), 1),
    "shadow_detail 0.7": (Quality(shadow_detail=0.7), 1), "shadow_detail 0.5": (Quality(shadow_detail=0.5), 1)}


class _Run:
    """One pipeline over the clip's first frames."""

    def __init__(self, context: Context, pictures: list[YuvFrame], scene: Scene) -> None:
        self._pictures, self._scene = pictures, scene
        self.pipeline = Pipeline(context, YuvFrame, pictures[0].size)
        warm_up(self.pipeline, pictures[0].size)
        self.need = LightNeed(pictures[0].size[0])

    def ideal(self) -> list[Luma]:
        """Each frame by its own light."""
        return [self._luma(picture, index, None) for index, picture in enumerate(self._pictures)]

    def _luma(self, picture: YuvFrame, index: int, light: Any) -> Luma:
        frame = self.pipeline.render(picture, self._scene, light=light, moment=index / FPS).frame
        assert isinstance(frame, YuvFrame)
        return frame.y

    def live(self, quality: Quality, every: int) -> tuple[list[Luma], float, Costs]:
        """Lumas, milliseconds a frame after the warm-up, and the seconds of each step."""
        self.pipeline.quality, lumas, light = quality, [], None
        spent, steps = 0.0, {"render": 0.0, "read": 0.0, "glossy": 0.0, "shadows": 0.0, "objects": 0.0}
        for index, picture in enumerate(self._pictures):
            started = time.process_time()
            lumas.append(self._luma(picture, index, light))
            rendered = time.process_time()
            if light is None or index % every == 0:
                light, _ = self.pipeline.read_light(index / FPS)
                read = time.process_time()
                self.need.learn(light, index / FPS)
                timings = self.pipeline.prepare(light)
                prepared = time.process_time()
            elif self.pipeline.is_behind:
                self.pipeline.prepare(light)
            if index < WARM_UP:
                continue
            spent += time.process_time() - started
            steps["render"] += rendered - started
            if index % every == 0:
                steps["read"] += read - rendered
                for name, stage in (("glossy", "glossy"), ("shadows", "shadows"), ("objects", "objects_and_composite")):
                    steps[name] += timings.stages.get(stage, 0.0) / max(timings.total, 1e-9) * (prepared - read)
        count = len(self._pictures) - WARM_UP
        costs = Costs(**{name: value / count * (1 if name == "render" else every) for name, value in steps.items()})
        return lumas, 1e3 * spent / count, costs


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--width", type=int, default=2048)
    arguments = parser.parse_args()
    pictures = list(_decoded(arguments.width, WARM_UP + arguments.frames))
    context, scene = Context(), five_objects()
    reference = _Run(context, pictures, scene)
    ideal = reference.ideal()
    reference.pipeline.release()
    situation = None
    print(f"{'':22}{'error':>8}{'more':>8}{'model':>8}{'ms':>8}{'saved':>8}{'model':>8}")
    for name, (quality, every) in VARIANTS.items():
        run = _Run(context, pictures, scene)
        lumas, spent, costs = run.live(quality, every)
        error = _error(pictures[WARM_UP:], ideal[WARM_UP:], lumas[WARM_UP:])
        if situation is None:
            situation, first, full = Situation(1 / FPS, costs, run.need.rate, run.need.ground_shares), error, spent
        tolerance = max(1.0, every * situation.rate / FPS) if every > 1 else 1.0
        effort = Effort(quality, tolerance)
        saved = 1e3 * (predicted_cost_s(FULL_EFFORT, situation) - predicted_cost_s(effort, situation))
        print(f"{name:22}{error:8.4f}{error - first:8.4f}{predicted_error(effort, situation):8.4f}{spent:8.2f}{full - spent:8.2f}"
              f"{saved:8.2f}  {_shown(costs)}", flush=True)
        run.pipeline.release()
    context.release()


def _shown(costs: Costs) -> str:
    return ", ".join(f"{name} {1e3 * value:.1f}" for name, value in costs._asdict().items())


def _decoded(width: int, count: int) -> Iterator[YuvFrame]:
    reader = PictureReader((width, width // 2))
    with av.open(str(demo_clip(width, FPS))) as container:
        for frame, _ in zip(container.decode(video=0), range(count), strict=False):
            yield reader.read(frame).copy()


def _error(pictures: list[YuvFrame], ideal: list[Luma], found: list[Luma]) -> float:
    off = whole = 0.0
    for picture, right, luma in zip(pictures, ideal, found, strict=True):
        touched = (right != picture.y) | (luma != picture.y)
        off += float(np.abs(LINEAR[right[touched]] - LINEAR[luma[touched]]).sum())
        whole += float(LINEAR[right[touched]].sum())
    return off / max(whole, 1e-9)


if __name__ == "__main__":
    main()

"""The JSON report of a demo run, from samples of the service's counters and of the demo's own viewer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

SETTLING_S = 10.0       # at the start of a run, not measured
WINDOW_FRAMES = 300     # what the percentiles of one sample cover


@dataclass(frozen=True)
class Sample:
    """What was known at `time` (monotonic seconds)."""

    time: float
    stats: dict[str, Any]       # GET /api/streams/live/stats
    viewer: dict[str, Any]      # last line of server.demo.viewer
    cpu_seconds: dict[str, float]


def demo_report(samples: Sequence[Sample], renderer: str | None) -> dict[str, Any]:
    """Rates and latencies between the first and the last of two or more samples.

    Percentiles are the worst among the consecutive windows of WINDOW_FRAMES that the service computes them over.
    """
    first, last = samples[0], samples[-1]
    windows = _windows(samples)
    cpu_seconds = {name: round(last.cpu_seconds[name] - first.cpu_seconds[name], 2) for name in last.cpu_seconds}
    return {
        "seconds": round(last.time - first.time, 2),
        "frames_in": _increase(samples, "frames_in"),
        "frames_out": _increase(samples, "frames_encoded"),
        "frames_dropped": _increase(samples, "frames_dropped"),
        "dropped_after_encoder": _increase(samples, "dropped_after_encoder"),
        "worker_restarts": _increase(samples, "worker_restarts"),
        "fps": _rate([(sample.time, sample.stats["frames_encoded"]) for sample in samples]),
        "viewer_fps": _rate([(sample.viewer["time"], sample.viewer["frames"]) for sample in samples]),
        "viewer_size": [last.viewer["width"], last.viewer["height"]],
        "render_ms": _worst([sample.stats["render_ms"] for sample in windows]),
        "latency_ms": _worst([sample.stats["latency_ms"] for sample in windows]),
        "stages_ms": {stage: _worst([sample.stats["stages_ms"].get(stage) for sample in windows])
                      for stage in last.stats["stages_ms"]},
        "touched_fraction": last.stats["touched_fraction"],
        "renderer": renderer,
        "cpu_seconds": round(cpu_seconds["worker"] + cpu_seconds["server"], 2),
        "cpu_seconds_by_process": cpu_seconds,
    }


def _increase(samples: Sequence[Sample], counter: str) -> int:
    steps = (int(after.stats[counter] - before.stats[counter]) for before, after in pairwise(samples))
    return sum(max(step, 0) for step in steps)      # a replaced worker counts from 0 again


def _rate(points: Sequence[tuple[float, int]]) -> float:
    """Counts a second: the slope through the moments at which the count was seen to have changed.

    The counters come every half second; two of them, up to that old, would be wrong by some percent.
    """
    changes = [after for before, after in pairwise(points) if after[1] != before[1]]
    if len(changes) < 2:
        return 0.0
    times, counts = np.array(changes, float).T
    return round(float(np.polyfit(times - times[0], counts, 1)[0]), 2)


def _windows(samples: Sequence[Sample]) -> list[Sample]:
    """Every sample whose percentiles cover the next WINDOW_FRAMES, and the last one."""
    chosen = []
    covered = samples[0].stats["frames_rendered"]
    for sample in samples:
        if sample.stats["frames_rendered"] - covered >= WINDOW_FRAMES:
            chosen.append(sample)
            covered = sample.stats["frames_rendered"]
    if not chosen or samples[-1].stats["frames_rendered"] > covered:
        chosen.append(samples[-1])
    return chosen


def _worst(percentiles: Sequence[dict[str, float] | None]) -> dict[str, float] | None:
    known = [one for one in percentiles if one]
    return {key: round(max(one[key] for one in known), 2) for key in ("p50", "p95", "max")} if known else None

"""The demo's report from known samples."""

from __future__ import annotations

import pytest

from server.demo.report import Sample, demo_report


def samples(seconds: int = 20, fps: float = 30.0, every: float = 0.2, restart_at: int | None = None) -> list[Sample]:
    """A steady run as it is seen: the worker counts every half second, the service is asked every 0.2 s."""
    made = []
    for index in range(round(seconds / every) + 1):
        now = index * every
        frames = int(int(now / 0.5) * 0.5 * fps)
        if restart_at is not None and index >= restart_at:
            frames -= int(int(restart_at * every / 0.5) * 0.5 * fps)
        percentiles = {"p50": 8.0, "p95": 10.0 + (5.0 if frames >= 500 else 0.0), "max": 20.0}
        stats = {"frames_in": frames, "frames_encoded": frames, "frames_rendered": frames, "frames_dropped": 0,
                 "dropped_after_encoder": 0, "worker_restarts": 0, "render_ms": percentiles, "latency_ms": percentiles,
                 "stages_ms": {"light": percentiles}, "touched_fraction": 0.05}
        viewer = {"time": 100 + now, "frames": int(now * fps), "width": 2048, "height": 1024}
        made.append(Sample(now, stats, viewer, {"worker": now * 0.9, "server": now * 0.1}))
    return made


def test_rates_are_not_wrong_by_the_age_of_the_counters() -> None:
    report = demo_report(samples(fps=30.0), "llvmpipe")
    assert report["fps"] == pytest.approx(30.0, abs=0.1)
    assert report["viewer_fps"] == pytest.approx(30.0, abs=0.1)
    assert report["frames_out"] == 600
    assert report["cpu_seconds"] == pytest.approx(20.0)
    assert report["renderer"] == "llvmpipe"


def test_percentiles_are_the_worst_window() -> None:
    report = demo_report(samples(), "llvmpipe")
    assert report["render_ms"] == {"p50": 8.0, "p95": 15.0, "max": 20.0}
    assert report["stages_ms"]["light"]["p95"] == 15.0


def test_only_what_a_dead_worker_had_not_told_is_lost() -> None:
    report = demo_report(samples(restart_at=50), "llvmpipe")
    assert report["frames_in"] == pytest.approx(600, abs=15)

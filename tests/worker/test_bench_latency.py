"""The benchmark of latency: what it makes of frames that were seen, and a small run in a real Chromium where there is one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from server.bench import latency
from server.bench.latency_figures import browser_figures, frame_figures
from server.bench.latency_page import CHROMIUM, Shown
from server.demo.watch import DemoError

ORIGIN = 1_763_750_000.0


def shown(number: int, coded: bool = True) -> Shown:
    """A frame taken at number / 10 s, decoded by the service 20 ms later, received after 50, called back after 80, shown after
    90."""
    at = ORIGIN + number / 10
    return Shown(coded_at=at if coded else None, rtp_timestamp=number * 9000, received_at=at + 0.05, decode_s=0.004,
                 called_at=at + 0.08, displayed_at=at + 0.09, presented=number + 1, width=1024)


def test_stages_add_up_to_the_whole() -> None:
    figures = frame_figures([shown(number) for number in range(20)], ORIGIN + 0.02)
    assert figures["frames"] == 20
    assert figures["glass_to_glass_ms"]["p50"] == pytest.approx(90.0, abs=0.2)
    stages = [one["p50"] for name, one in figures["stages_ms"].items() if not name.startswith(" ")]
    assert stages == pytest.approx([20.0, 30.0, 30.0, 10.0], abs=0.2)
    assert figures["longest_gap_ms"] == pytest.approx(100.0, abs=0.2)
    assert figures["not_presented"] == 0


def test_frames_without_a_code_are_told_and_too_many_are_an_error() -> None:
    assert frame_figures([shown(number, coded=number != 3) for number in range(6)], ORIGIN)["without_code"] == 1
    with pytest.raises(DemoError, match="in 2 of 6 frames"):
        frame_figures([shown(number, coded=number < 2) for number in range(6)], ORIGIN)


def test_means_are_of_the_period_alone() -> None:
    before = {"jitterBufferDelay": 1.0, "jitterBufferEmittedCount": 10, "framesDecoded": 10, "totalDecodeTime": 1.0}
    after = {"jitterBufferDelay": 1.8, "jitterBufferEmittedCount": 30, "framesDecoded": 30, "totalDecodeTime": 1.1}
    figures = browser_figures(before, after)
    assert (figures["jitter_buffer_ms"], figures["decode_ms"], figures["framesDecoded"]) == (40.0, 5.0, 20)
    assert figures["processing_ms"] == 0.0
    assert figures["assembly_ms"] is None


def test_a_small_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    if not Path(CHROMIUM).exists():
        pytest.skip(f"{CHROMIUM} is not installed")
    file = tmp_path / "latency.json"
    assert latency.main(["--size", "512x256", "--fps", "10", "--seconds", "3", "--warm-up", "2", "--json", str(file)]) == 0
    report: dict[str, Any] = json.loads(file.read_text())
    assert report["frames"] > 10
    assert report["without_code"] == 0
    whole = report["glass_to_glass_ms"]
    assert 0 < whole["p50"] < 5000
    assert report["stages_ms"]["time code to decoded by the service"]["p50"] > 0
    assert abs(report["clock_offset_ms"]) < 50, "browser and camera are on one machine"
    assert "glass to glass" in capsys.readouterr().out


def test_bad_arguments_are_status_2_and_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        latency.main(["--seconds", "x"])
    error = capsys.readouterr().err
    assert (ended.value.code, error.count("\n")) == (2, 1)
    assert "'x' given, expected a number of seconds" in error

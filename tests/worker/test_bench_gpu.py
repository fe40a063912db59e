"""`make bench-gpu`: stage times by timer queries, on whatever renderer there is."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from server.bench import gpu


def test_every_stage_has_a_time_on_the_graphics_processor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                                                          capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys, "argv", ["bench-gpu", "--sizes", "512x256", "--frames", "5", "--json", str(tmp_path / "gpu.json")])
    assert gpu.main() == 0
    rows = json.loads((tmp_path / "gpu.json").read_text())["sizes"]["512x256"]
    assert {"upload", "radiance_map", "lights", "shadows", "objects_and_composite", "write", "all"} <= rows.keys()
    assert rows["all"]["gpu_ms"]["p50"] > 0
    assert rows["objects_and_composite"]["gpu_ms"]["p50"] > rows["lights"]["gpu_ms"]["p50"], "numpy draws nothing"
    assert "objects_and_composite" in capsys.readouterr().out


@pytest.mark.parametrize(("given", "message"), [
    (["--sizes", "1000x1000"], "size is '1000x1000', expected WIDTHxHEIGHT with width twice the height"),
    (["--frames", "0"], "--frames is 0, expected at least 1")])
def test_bad_arguments(given: list[str], message: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys, "argv", ["bench-gpu", *given])
    assert gpu.main() == 2
    assert message in capsys.readouterr().err

"""`mr360 bench` as a command: what it prints and writes, and what it refuses."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import pytest

from server.bench import report
from server.bench.pipelines import Pipelines
from server.bench.report import run_bench
from tests.worker.test_bench import TINY


@pytest.mark.parametrize(("arguments", "text"), [
    ({"plot": Path("x.pdf")}, "plot 'x.pdf', expected a name that ends in .png or .svg"),
    ({"plot": Path("/no/such/folder/x.png")}, "plot folder '/no/such/folder' does not exist"),
    ({"json": Path("/no/such/folder/x.json")}, "json folder '/no/such/folder' does not exist")])
def test_bad_files_are_refused_before_any_work(arguments: dict[str, Path], text: str, capsys: pytest.CaptureFixture[str],
                                               monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report, "measured", lambda *_: pytest.fail("work was begun"))
    given = argparse.Namespace(**{"quick": True, "json": None, "plot": None, **arguments})
    assert run_bench(given) == 2
    assert capsys.readouterr().err == f"mr360 bench: {text}\n"


def test_the_report_is_printed_and_written(tmp_path: Path, capsys: pytest.CaptureFixture[str],
                                           monkeypatch: pytest.MonkeyPatch) -> None:
    """The whole command, with two of its stages and no more than two hard cases, one of which is missed."""
    def missed(_pipelines: Pipelines) -> None:
        raise ValueError("nothing works")

    monkeypatch.setattr(report, "QUICK", TINY)
    monkeypatch.setattr(report, "STAGES", (report.STAGES[2], report.STAGES[5]))
    monkeypatch.setattr(report, "light_cases", lambda: {"met": lambda _: None, "missed": missed})
    monkeypatch.setattr(report, "scene_cases", dict)
    given = argparse.Namespace(quick=True, json=tmp_path / "r.json", plot=tmp_path / "r.png")
    assert run_bench(given) == 1
    text, found = capsys.readouterr().out, json.loads((tmp_path / "r.json").read_text())
    assert "HARD CASES: 1 of 2 passed" in text
    assert "missed: ValueError: nothing works" in text
    assert {row["stage"] for row in found["rows"]} == {"diffuse", "composite"}
    assert found["hard_cases"][1] == {"case": "missed", "passed": False, "missed": "ValueError: nothing works"}
    machine: dict[str, Any] = found["machine"]
    assert {"processors", "cpu", "renderer", "LP_NUM_THREADS", "load_average_start", "load_average_end", "date"} <= machine.keys()
    assert (tmp_path / "r.png").stat().st_size > 10_000
    assert len(found["needs"]) == 5
    assert found["frame_path"]["scenes"].keys() == {"demo", "five objects", "empty"}

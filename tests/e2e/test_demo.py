"""`mr360 demo` as a person starts it: everything real, in one command."""

from __future__ import annotations

import contextlib
import json
import re
import socket
import sys
from pathlib import Path

import httpx
import pytest
from processes import Process, wait_for

pytestmark = [pytest.mark.e2e, pytest.mark.alone]

PERCENTILES = {"p50", "p95", "max"}


def start_demo(log: Path, *arguments: str | Path) -> Process:
    return Process([sys.executable, "-m", "server.cli", "demo", "--width", "512", "--fps", "10", *arguments], log)


def test_a_timed_demo_ends_by_itself_with_a_report(tmp_path: Path) -> None:
    report_file = tmp_path / "demo.json"
    demo = start_demo(tmp_path / "demo.log", "--duration", "13", "--report", report_file)
    try:
        assert demo.wait(150) == 0, demo.output()[-3000:]
        assert not demo.descendants()
    finally:
        demo.kill()
    report = json.loads(report_file.read_text())
    assert 2 < report["seconds"] < 5
    assert report["viewer_size"] == [512, 256]
    assert report["viewer_fps"] == pytest.approx(report["fps"], abs=2)
    assert 0 < report["frames_out"] <= report["frames_in"] + 1
    assert report["dropped_after_encoder"] == report["worker_restarts"] == 0
    for percentiles in (report["render_ms"], report["latency_ms"], *report["stages_ms"].values()):
        assert set(percentiles) == PERCENTILES
        assert percentiles["p50"] <= percentiles["p95"] <= percentiles["max"]
    assert 0 < report["touched_fraction"] < 0.3, "the sample scene is not in the picture"
    assert report["renderer"]
    assert report["cpu_seconds"] > 0


def test_a_demo_beside_another_service_serves_until_ctrl_c(tmp_path: Path) -> None:
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError):      # already in use is just as good
            stack.enter_context(socket.create_server(("127.0.0.1", 8360)))
        demo = start_demo(tmp_path / "demo.log")
        stack.callback(demo.kill)

        def invited() -> re.Match[str] | None:
            assert demo.running(), demo.output()[-3000:]
            return re.search(r"(http://127\.0\.0\.1:(\d+))/view/live", demo.output())

        invitation = wait_for("invitation", invited, 150)
        base, port = invitation.groups()
        assert port != "8360"
        assert httpx.get(f"{base}/view/live", trust_env=False).status_code == 200
        placed = httpx.get(f"{base}/api/streams/live/objects", trust_env=False).json()
        assert {one["mesh"] for one in placed} == {"teapot", "sphere", "box"}
        assert demo.stop(3.0) == 0


@pytest.mark.parametrize(("arguments", "expected"), [
    (["--duration", "10"], "duration is 10, expected more than"),
    (["--report", "x.json"], "report is 'x.json' without a duration"),
    (["--width", "130"], "'130'"),
])
def test_bad_usage_is_status_2_and_one_line(tmp_path: Path, arguments: list[str], expected: str) -> None:
    demo = start_demo(tmp_path / "demo.log", *arguments)
    assert demo.wait(60) == 2
    assert expected in demo.output()
    assert demo.output().count("\n") == 1

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
from pathlib import Path

import httpx
import pytest
from conftest import ROOT, start_service, stop_service, wait_for
from whep_viewer import WhepViewer


def mr360(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", "server.cli", *arguments], cwd=ROOT, capture_output=True, text=True,
                          timeout=60, env={**os.environ, **environment}, check=False)


@pytest.mark.parametrize(("arguments", "text"), [
    ([], "COMMAND"),
    (["fly"], "'fly'"),
    (["serve", "--prot", "1"], "--prot"),
    (["serve", "--port", "abc"], "port is 'abc' (command line), expected a valid integer"),
    (["serve", "--port", "70000"], "port is '70000'"),
    (["serve", "--source", "http://camera/x"], "is 'http', expected one of rtsp"),
    (["serve", "--source", "/no/such/file.mp4"], "'/no/such/file.mp4' does not exist"),
    (["serve", "--config", "/no/such/file.toml"], "'/no/such/file.toml' cannot be read"),
    (["serve", "--host", "256.0.0.1", "--port", "0"], "cannot listen on 256.0.0.1"),
    (["demo", "--duration", "-1"], "'-1' given, expected a number above 0"),
    (["demo", "--duration", "nan"], "'nan' given"),
    (["demo", "--width", "1001"], "'1001' given, expected a multiple of 4"),
    (["demo", "--fps", "0"], "'0' given"),
    (["render", "x.png"], "--output"),
    (["render", "x.png", "--output", "y.png", "--preset", "fast"], "'fast'"),
    (["lights", "x.png", "--method", "magic"], "'magic'"),
    (["lights", "x.png", "--count", "0"], "'0' given, expected auto or a number from 1 to 64"),
    (["publish", "x.mp4"], "URL"),
    (["bench", "--plot", "x.pdf"], "expected a name that ends in .png or .svg"),
])
def test_bad_usage_is_status_2_and_one_line(arguments: list[str], text: str) -> None:
    done = mr360(*arguments)
    assert done.returncode == 2
    assert done.stdout == ""
    assert text in done.stderr
    assert done.stderr.count("\n") == 1


def test_an_unknown_environment_variable_is_refused() -> None:
    done = mr360("serve", MR360_PROT="1")
    assert done.returncode == 2
    assert "setting 'prot' (environment) is unknown" in done.stderr


@pytest.mark.parametrize("command", [[], ["serve"], ["demo"], ["render"], ["lights"], ["publish"]])
def test_help(command: list[str]) -> None:
    done = mr360(*command, "--help")
    assert done.returncode == 0
    assert "usage: mr360" in done.stdout


def test_port_in_use_is_status_2_and_one_line() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        done = mr360("serve", "--port", str(port))
    assert done.returncode == 2
    assert f"cannot listen on 127.0.0.1 port {port}: address already in use" in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
async def test_a_signal_ends_everything(panorama: Path, tmp_path: Path, number: signal.Signals) -> None:
    """With a viewer and a socket connected, and a worker that is stopped: the worst case."""
    served = start_service("--source", str(panorama), assets_dir=tmp_path / "assets")
    try:
        async with WhepViewer(served.url) as viewer:
            await viewer.next_frame()
            pids = served.worker_pids()
            os.kill(pids[0], signal.SIGSTOP)
            served.process.send_signal(number)
            assert served.process.wait(timeout=10) == 0     # 3 s is promised; this machine may be busy
        for pid in pids:
            with pytest.raises(ProcessLookupError):
                os.kill(pid, 0)
    finally:
        stop_service(served)


def test_without_source_the_stream_is_idle(tmp_path: Path) -> None:
    served = start_service(assets_dir=tmp_path / "assets")
    try:
        with httpx.Client(base_url=served.url, timeout=30) as client:
            wait_for(lambda: client.get("/readyz").status_code == 200, "ready", 60)
            live = client.get("/api/streams/live").json()
            assert (live["state"], live["source"], live["input"]) == ("idle", None, None)
            assert re.fullmatch(r"http://127\.0\.0\.1:\d+", served.url)
            assert client.get("/api/streams/live/lights").status_code == 503
            assert client.get("/api/streams/live/snapshot.jpg").status_code == 503
    finally:
        stop_service(served)

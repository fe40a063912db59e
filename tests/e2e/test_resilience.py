"""Viewers that do not read, workers that die, Ctrl-C in the middle of everything."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from headless_viewer import HeadlessViewer
from media_servers import NginxRtmp, Publisher
from processes import PROJECT, wait_for
from running_service import Service
from websockets.sync.client import connect

pytestmark = pytest.mark.e2e


@pytest.fixture
def playing(service: Service, nginx_rtmp: NginxRtmp, publisher: Callable[..., Publisher], clip: Path) -> Service:
    """A service whose stream `live` shows the synthetic camera."""
    publisher(clip, nginx_rtmp.url("camera"))
    service.pull(nginx_rtmp.url("camera"))
    return service


def test_viewers_that_never_read_hold_nobody_up(playing: Service, viewer: Callable[[str], HeadlessViewer]) -> None:
    lazy, keen = viewer(playing.url), viewer(playing.url)
    lazy.wait_frames(5)
    keen.wait_frames(5)
    alone = rate(keen, 45)
    lazy.process.signal(signal.SIGSTOP)
    lights = playing.url.replace("http", "ws") + "/api/streams/live/lights"
    with connect(lights, proxy=None, max_queue=1, close_timeout=0.5):
        assert rate(keen, 60) > 0.6 * alone
    assert playing.request("GET", "/readyz")["status"] == "ready"
    lazy.process.signal(signal.SIGCONT)


def rate(viewer: HeadlessViewer, frames: int) -> float:
    """Frames a second over the next so many."""
    before = viewer.progress()
    after = viewer.wait_frames(frames, seconds=60)
    return float((after["frames"] - before["frames"]) / (after["time"] - before["time"]))


def test_a_killed_worker_is_replaced_and_its_viewer_stays(playing: Service,
                                                          viewer: Callable[[str], HeadlessViewer]) -> None:
    playing.place(id="ball", mesh="sphere", position=[0, -1, -2])
    watching = viewer(playing.url)
    before = watching.wait_frames(15)
    worker, = worker_pids(playing)
    os.kill(worker, signal.SIGKILL)
    wait_for("replaced worker", lambda: playing.stream()["worker"]["restarts"] == 1, 20)
    playing.wait_live("live")
    after = watching.wait_frames(15, seconds=60)
    assert after["state"] == "connected"
    assert playing.stream()["viewers"] == 1
    assert after["timestamp"] > before["timestamp"], "the RTP clock went back"
    assert worker not in worker_pids(playing)
    assert [placed["id"] for placed in playing.request("GET", "/api/streams/live/objects")] == ["ball"]


def test_a_worker_that_hangs_is_replaced(playing: Service, viewer: Callable[[str], HeadlessViewer]) -> None:
    watching = viewer(playing.url)
    watching.wait_frames(5)
    worker, = worker_pids(playing)
    os.kill(worker, signal.SIGSTOP)
    wait_for("replaced worker", lambda: playing.stream()["worker"]["restarts"] == 1, 20)
    playing.wait_live("live")
    watching.wait_frames(15, seconds=60)
    assert not Path(f"/proc/{worker}").exists()


def test_ctrl_c_ends_everything_while_viewers_watch(playing: Service, viewer: Callable[[str], HeadlessViewer]) -> None:
    watching = viewer(playing.url)
    watching.wait_frames(5)
    with connect(playing.url.replace("http", "ws") + "/api/streams/live/events", proxy=None):
        playing.stop()


def test_ctrl_c_ends_a_service_that_is_just_starting(start_service: Callable[..., Service]) -> None:
    starting = start_service(wait=False)
    wait_for("listening service", lambda: "serves" in starting.process.output(), 30)
    starting.stop()


def test_ctrl_c_ends_a_service_that_connects_in_vain(start_service: Callable[..., Service]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        service = start_service("--source", f"rtsp://127.0.0.1:{silent.getsockname()[1]}/live", wait=False)
        wait_for("ready worker", lambda: "worker ready" in service.process.output(), 60)
        time.sleep(1)       # now its ingest waits for an answer
        service.stop()


def test_a_port_in_use_is_status_2_and_one_line(service: Service) -> None:
    ended = subprocess.run([sys.executable, "-m", "server.cli", "serve", "--port", str(service.port)], cwd=PROJECT,
                           capture_output=True, text=True, timeout=60, check=False)
    assert ended.returncode == 2
    assert f"port {service.port}" in ended.stderr
    assert "in use" in ended.stderr
    assert ended.stderr.count("\n") == 1
    assert service.request("GET", "/healthz")["status"] == "alive"


def worker_pids(service: Service) -> list[int]:
    return [pid for pid in service.process.descendants()
            if b"server.worker" in Path(f"/proc/{pid}/cmdline").read_bytes()]

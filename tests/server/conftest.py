"""One real service for the whole run: `mr360 serve` as a process, with its real worker and an image as its source."""

from __future__ import annotations

import os
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import httpx
import numpy as np
import pytest
from PIL import Image

ROOT = Path(__file__).resolve().parents[2]
START_LIMIT_S = 60.0


@dataclass(frozen=True)
class Served:
    """A running `mr360 serve`."""

    url: str
    process: subprocess.Popen[str]
    assets_dir: Path

    def worker_pids(self) -> list[int]:
        """The service's child processes that are workers of streams."""
        children = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children").read_text().split()
        return [int(pid) for pid in children if _is_worker(int(pid))]


def _is_worker(pid: int) -> bool:
    try:
        return b"server.worker" in Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return False


def wait_for(condition: Callable[[], object], what: str, limit_s: float = 30.0) -> None:
    deadline = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < deadline, f"{what}: not within {limit_s} s"
        time.sleep(0.05)


def start_service(*arguments: str, assets_dir: Path) -> Served:
    environment = {key: value for key, value in os.environ.items() if not key.startswith("MR360_")}
    environment["MR360_ASSETS_DIR"] = str(assets_dir)
    process = subprocess.Popen(
        [sys.executable, "-m", "server.cli", "serve", "--port", "0", *arguments],
        cwd=ROOT, env=environment, stdout=subprocess.PIPE, text=True)
    lines: queue.Queue[str] = queue.Queue()
    assert process.stdout is not None
    threading.Thread(target=lambda out=process.stdout: lines.put(out.readline()), daemon=True).start()
    line = lines.get(timeout=START_LIMIT_S)
    assert line.startswith("mr360 serves http://"), line
    return Served(line.split()[-1], process, assets_dir)


def stop_service(served: Served) -> None:
    served.process.terminate()
    try:
        served.process.wait(timeout=10)
    finally:
        served.process.kill()
        served.process.wait()
        assert served.process.stdout is not None
        served.process.stdout.close()


@pytest.fixture(scope="session")
def panorama(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A 512×256 panorama with a bright sun on a blue gradient."""
    picture = np.zeros((256, 512, 3), np.uint8)
    picture[..., 2] = np.linspace(200, 40, 256)[:, None]
    picture[..., 1] = np.linspace(120, 60, 512)[None, :]
    picture[60:70, 300:310] = 255
    path = tmp_path_factory.mktemp("panorama") / "panorama.png"
    Image.fromarray(picture).save(path)
    return path


@pytest.fixture(scope="session")
def served(panorama: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    served = start_service("--source", str(panorama), assets_dir=tmp_path_factory.mktemp("assets"))
    try:
        with httpx.Client(base_url=served.url, timeout=30) as client:
            wait_for(lambda: client.get("/api/streams/live").json()["state"] == "live", "stream is live", START_LIMIT_S)
        yield served
    finally:
        stop_service(served)


@pytest.fixture
def client(served: Served) -> Iterator[httpx.Client]:
    """An HTTP client of the service, whose stream `live` has the default scene."""
    with httpx.Client(base_url=served.url, timeout=30) as client:
        assert client.put("/api/streams/live/scene", json={}).status_code == 200
        yield client

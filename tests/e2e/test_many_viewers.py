"""Two hundred viewers come and go: the service holds afterwards what it held before."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from media_servers import Publisher
from processes import Process, free_port, wait_for

from server.bench.service_processes import memory_of
from server.demo.clip import demo_clip
from server.demo.viewer import Viewer

pytestmark = [pytest.mark.e2e, pytest.mark.alone]

CYCLES, AT_ONCE, WARM_UP = 200, 4, 150     # as long as that the allocator takes to settle
WATCHES_S = 0.1
MOST_OBJECTS = 1.0          # a cycle: each viewer had thousands
MOST_HEAP_MB, MOST_RESIDENT_MB = 1.0, 8.0
GIVES_BACK_WITHIN_S = 15.0


class CountedService:
    """A service as a process that can be asked what it holds."""

    def __init__(self, folder: Path) -> None:
        port, self._file = free_port(), folder / "holdings.json"
        self.url, self.camera = f"http://127.0.0.1:{port}", f"rtmp://127.0.0.1:{free_port()}/live/camera"
        script = str(Path(__file__).with_name("counted_service.py"))
        self.process = Process([sys.executable, script, str(self._file), "serve", "--port", str(port), "--source",
                                self.camera.replace("rtmp:", "rtmp-listen:")], folder / "service.log",
                               {"MR360_ASSETS_DIR": str(folder / "assets"), "PYTHONPATH": os.getcwd()})

    def stream(self) -> dict[str, Any]:
        try:
            found: dict[str, Any] = httpx.get(f"{self.url}/api/streams/live", trust_env=False).json()
        except httpx.TransportError:
            assert self.process.running(), self.process.output()[-3000:]
            return {"state": None}
        return found

    def holdings(self) -> dict[str, float]:
        """Once all viewers have left, and the threads and tasks of their requests are done."""
        wait_for("leaving of all viewers", lambda: self.stream()["viewers"] == 0, 30)
        time.sleep(1.0)
        self._file.unlink(missing_ok=True)
        self.process.signal(signal.SIGUSR2)
        wait_for("holdings", self._file.exists, 10)
        found: dict[str, float] = json.loads(self._file.read_text())
        return found


@pytest.fixture
def counted(tmp_path: Path) -> Iterator[CountedService]:
    service = CountedService(tmp_path)
    publisher = None
    try:
        wait_for("service", lambda: service.stream()["state"] is not None, 60)
        publisher = Publisher(demo_clip(256, 10), service.camera, tmp_path / "camera.log")
        wait_for("picture", lambda: service.stream()["state"] == "live", 60)
        yield service
    finally:
        if publisher is not None:
            publisher.process.kill()
        service.process.stop(5.0)


def test_two_hundred_viewers_leave_nothing_behind(counted: CountedService) -> None:
    asyncio.run(come_and_go(counted.url, WARM_UP))
    before = counted.holdings()
    began = time.monotonic()
    asyncio.run(come_and_go(counted.url, CYCLES))
    seconds = time.monotonic() - began
    after = counted.holdings()
    figures = f"{CYCLES} cycles in {seconds:.0f} s: before {before}, after {after}"
    print(figures)
    assert after["tasks"] <= before["tasks"], figures
    assert after["descriptors"] <= before["descriptors"], figures
    assert after["objects"] - before["objects"] <= MOST_OBJECTS * CYCLES, figures
    assert after["heap_mb"] - before["heap_mb"] <= MOST_HEAP_MB, figures
    # What was in use at once is given back a little later.
    most = before["resident_mb"] + MOST_RESIDENT_MB
    wait_for(f"{most:.0f} resident MB; {figures}", lambda: memory_of(counted.process.pid).now_mb <= most, GIVES_BACK_WITHIN_S)


async def come_and_go(url: str, count: int) -> None:
    """So many viewers, AT_ONCE at the same time; every other one just closes its connection, without DELETE."""
    places = asyncio.Semaphore(AT_ONCE)

    async def visit(number: int) -> None:
        async with places:
            viewer = Viewer(f"{url}/whep/live")
            try:
                await viewer.start()
                async with asyncio.timeout(20):
                    while viewer.state != "connected":  # noqa: ASYNC110 - aiortc's state, which tells nobody
                        await asyncio.sleep(0.02)
                await asyncio.sleep(WATCHES_S)
                if number % 2:
                    await viewer.peer.close()
            finally:
                await viewer.stop() if not number % 2 else await viewer.peer.close()

    await asyncio.gather(*(visit(number) for number in range(count)))

"""A worker that dies or hangs is replaced; the viewers keep their connection and see pictures again."""

from __future__ import annotations

import asyncio
import os
import signal
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from conftest import Served, start_service, stop_service, wait_for
from whep_viewer import WhepViewer

LIVE = "/api/streams/live"


@pytest.fixture
def fresh(panorama: Path, tmp_path: Path) -> Iterator[Served]:
    """A service of this test's own: its worker is to be killed."""
    served = start_service("--source", str(panorama), assets_dir=tmp_path / "assets")
    try:
        with httpx.Client(base_url=served.url, timeout=30) as client:
            wait_for(lambda: client.get(LIVE).json()["state"] == "live", "stream is live", 60)
        yield served
    finally:
        stop_service(served)


def gone(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    return False


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
async def test_pictures_come_again_on_the_same_connection(fresh: Served, number: signal.Signals) -> None:
    async with httpx.AsyncClient(base_url=fresh.url, timeout=30) as client, WhepViewer(fresh.url) as viewer:
        await client.put(f"{LIVE}/scene", json={"camera_height": 2.5})
        for _ in range(20):
            await viewer.next_frame()
        pid, = fresh.worker_pids()
        last_before = viewer.rtp[-1].timestamp
        os.kill(pid, number)
        async with asyncio.timeout(60):
            while (await client.get(LIVE)).json()["worker"]["restarts"] == 0:  # noqa: ASYNC110
                await asyncio.sleep(0.1)
        packets_before = len(viewer.rtp)
        async with asyncio.timeout(60):
            while len(viewer.rtp) == packets_before:  # noqa: ASYNC110
                await asyncio.sleep(0.1)
        for _ in range(20):
            await viewer.next_frame()
        assert viewer.connection.connectionState == "connected"
        assert gone(pid)
        stamps = [packet.timestamp for packet in viewer.rtp]
        assert max(stamps) > last_before
        assert max(stamps) - last_before < 120 * 90_000
        stats = (await client.get(f"{LIVE}/stats")).json()
        assert stats["dropped_after_encoder"] == 0
        assert stats["worker_restarts"] == 1
        assert (await client.get(f"{LIVE}/scene")).json()["camera_height"] == 2.5


def test_readiness_tells_the_truth_while_the_worker_is_replaced(fresh: Served) -> None:
    with httpx.Client(base_url=fresh.url, timeout=30) as client:
        assert client.get("/readyz").status_code == 200
        pid, = fresh.worker_pids()
        os.kill(pid, signal.SIGKILL)
        wait_for(lambda: client.get("/readyz").status_code == 503, "not ready")
        assert client.get("/readyz").json()["streams"]["live"]
        assert client.get("/healthz").status_code == 200
        wait_for(lambda: client.get("/readyz").status_code == 200, "ready again", 60)
        assert pid not in fresh.worker_pids()


def test_a_hung_worker_blocks_nothing(fresh: Served) -> None:
    """Scene edits while the worker is stopped are answered at once and reach the next worker."""
    with httpx.Client(base_url=fresh.url, timeout=30) as client:
        pid, = fresh.worker_pids()
        os.kill(pid, signal.SIGSTOP)
        objects = [{"id": f"o{number}", "mesh": "box", "position": [number, 0, -2]} for number in range(100)]
        for height in range(100):
            scene = {"camera_height": 1 + height / 100, "objects": objects}
            assert client.put(f"{LIVE}/scene", json=scene).status_code == 200
        revision = int(client.get(f"{LIVE}/scene").headers["etag"].strip('"').rpartition("-")[2])

        def rendered() -> bool:
            client.get(f"{LIVE}/lights")
            return bool(client.get(f"{LIVE}/stats").json().get("scene_revision") == revision)

        wait_for(rendered, "the replaced worker renders the newest scene", 60)
        assert gone(pid)


def test_no_worker_outlives_a_service_that_is_killed(fresh: Served) -> None:
    pids = fresh.worker_pids()
    assert pids
    fresh.process.kill()
    fresh.process.wait()
    wait_for(lambda: all(gone(pid) for pid in pids), "the worker ends by itself", 10)

"""A stream and its supervisor, with child processes that end the way workers can."""

from __future__ import annotations

import asyncio
import json
import sys
import textwrap
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from test_worker_process import PRELUDE, ROOT

from server import supervisor, worker_process
from server.metrics import Metrics, StreamMetrics
from server.snapshots import SnapshotError
from server.stream import Stream, StreamSettings

LIMIT_S = 60.0
READY = 'send({"type": "ready", "renderer": "none", "gl_version": "0"})\n'
PACKET = '''
def packet(timestamp):
    send({"type": "packet", "track": "full/h264", "frame": 1, "timestamp": timestamp, "keyframe": True, "decoded_at": 0.0,
          "render_ms": 1.0, "stages_ms": {}}, bytes([0, 0, 0, 1, 0x65]))
'''


@asynccontextmanager
async def running(program: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path,
                  source: str | None = None) -> AsyncIterator[Stream]:
    """A stream whose worker is the program."""
    script = tmp_path / "child.py"
    script.write_text(PRELUDE + textwrap.dedent(program))
    monkeypatch.setattr(worker_process, "WORKER_COMMAND", (sys.executable, str(script)))
    monkeypatch.setattr(supervisor, "BACKOFF_S", (0.05, 0.1))
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    stream = Stream("s", source, StreamSettings("/assets", False, None), StreamMetrics(Metrics(), "s"))
    task = asyncio.create_task(stream.run())
    try:
        yield stream
    finally:
        task.cancel()
        await asyncio.wait([task])
        assert task.cancelled()


async def until(condition: Callable[[], object]) -> None:
    async with asyncio.timeout(LIMIT_S):
        while not condition():  # noqa: ASYNC110
            await asyncio.sleep(0.01)


async def test_fatal_is_the_stream_s_state_and_not_tried_again_at_once(monkeypatch: pytest.MonkeyPatch,
                                                                      tmp_path: Path) -> None:
    program = 'send({"type": "fatal", "error": "no GL, install libegl1"})\nsys.exit(3)'
    async with running(program, monkeypatch, tmp_path) as stream:
        await until(lambda: stream.state == "failed")
        assert stream.detail == "no GL, install libegl1"
        await asyncio.sleep(0.5)
        assert stream.restarts == 0
        assert not stream.ready


async def test_a_worker_that_never_gets_ready_fails_the_stream_which_goes_on_trying(monkeypatch: pytest.MonkeyPatch,
                                                                                    tmp_path: Path) -> None:
    async with running("sys.exit(9)", monkeypatch, tmp_path) as stream:
        await until(lambda: stream.state == "failed")
        assert stream.detail == "the worker exited with status 9, it is replaced"
        tried = stream.restarts
        await until(lambda: stream.restarts > tried)


async def test_a_worker_that_gets_ready_ends_the_failure(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    marker = tmp_path / "tries"
    program = f"""
        open({str(marker)!r}, "a").write("x")
        if len(open({str(marker)!r}).read()) < 5:
            sys.exit(9)
        {READY.strip()}
        while True:
            send({{"type": "state", "source": "idle", "detail": None, "input": None, "output": None, "flags": []}})
            time.sleep(0.2)
    """
    async with running(program, monkeypatch, tmp_path) as stream:
        await until(lambda: stream.state == "failed")
        await until(lambda: stream.ready)
        assert (stream.state, stream.detail) == ("idle", None)


async def test_a_replaced_worker_goes_on_in_rtp_time_with_the_newest_scene(monkeypatch: pytest.MonkeyPatch,
                                                                          tmp_path: Path) -> None:
    """The first worker sends a packet just before 32 bits are full, then dies; the second tells its start, which goes on beyond."""
    marker = tmp_path / "first"
    program = f"""
        import json
        {textwrap.indent(PACKET, " " * 8).strip()}
        if not os.path.exists({str(marker)!r}):
            open({str(marker)!r}, "w").close()
            {READY.strip()}
            assert start["timestamp"] == 0
            packet(2**32 - 100)
            sys.exit(0)
        send({{"type": "state", "source": "lost", "detail": json.dumps([start["timestamp"], start["revision"]]),
              "input": None, "output": None, "flags": []}})
        time.sleep(60)
    """
    async with running(program, monkeypatch, tmp_path, "rtsp://127.0.0.1:9/x") as stream:
        await until(lambda: stream.restarts == 1)
        await until(lambda: (stream.detail or "").startswith("["))
        timestamp, revision = json.loads(stream.detail or "")
        assert 0 < timestamp - 2**32 < 90_000 * LIMIT_S
        assert revision == stream.live_scene.revision


async def test_a_message_that_is_wrong_replaces_the_worker(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for wrong in ('{"type": "packet"}', '{"type": "hello"}', '{"type": "lights", "message": 5}',
                  '{"type": "state", "source": "live"}', '{"type": "stats", "frames_in": "many"}'):
        async with running(f"{READY}send({wrong})\ntime.sleep(60)", monkeypatch, tmp_path) as stream:
            await until(lambda stream=stream: stream.restarts > 0)


async def test_snapshot_tells_why_there_is_none(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    program = READY + textwrap.dedent("""
        while True:
            message, _ = receive_message(connection)
            if message["type"] == "snapshot":
                send({"type": "snapshot", "request": message["request"], "error": "no frame yet"})
    """)
    async with running(program, monkeypatch, tmp_path) as stream:
        await until(lambda: stream.ready)
        with pytest.raises(SnapshotError, match="no frame yet"):
            await stream.snapshot()


async def test_snapshots_asked_for_at_once_share_the_answer(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    program = READY + textwrap.dedent("""
        asked = 0
        while True:
            message, _ = receive_message(connection)
            if message["type"] == "snapshot":
                asked += 1
                send({"type": "snapshot", "request": message["request"], "error": None}, b"picture %d" % asked)
    """)
    async with running(program, monkeypatch, tmp_path) as stream:
        await until(lambda: stream.ready)
        with stream.lights.subscription():       # frames are being made, no need to have one made
            assert await asyncio.gather(stream.snapshot(), stream.snapshot()) == [b"picture 1"] * 2
            assert await stream.snapshot() == b"picture 2"


async def test_a_snapshot_of_a_worker_that_dies_is_an_error_at_once(monkeypatch: pytest.MonkeyPatch,
                                                                    tmp_path: Path) -> None:
    program = READY + textwrap.dedent("""
        while receive_message(connection)[0]["type"] != "snapshot":
            pass
        os.abort()
    """)
    async with running(program, monkeypatch, tmp_path) as stream:
        await until(lambda: stream.ready)
        with pytest.raises(SnapshotError, match="the worker was ended by SIGABRT"):
            await stream.snapshot()

"""Supervision against child processes that misbehave in every way a worker can."""

from __future__ import annotations

import asyncio
import os
import sys
import textwrap
import time
from pathlib import Path

import pytest

from server import worker_process
from server.worker.messages import Message
from server.worker_process import WorkerProcess

PRELUDE = """
import os, signal, socket, sys, time
from server.worker.messages import encode_message, receive_message
connection = socket.socket(fileno=int(sys.argv[sys.argv.index("--fd") + 1]))
def send(message, payload=b""):
    connection.sendall(encode_message(message, payload))
start, _ = receive_message(connection)
"""
ROOT = Path(__file__).resolve().parents[2]
LIMIT_S = 20.0


async def run_child(program: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path,
                    *outgoing: Message) -> tuple[str, list[tuple[Message, bytes]]]:
    """Run the program as the worker. Returns why it ended and what it sent."""
    script = tmp_path / "child.py"
    script.write_text(PRELUDE + textwrap.dedent(program))
    monkeypatch.setattr(worker_process, "WORKER_COMMAND", (sys.executable, str(script)))
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    worker = await WorkerProcess.start({"type": "start", "stream": "s"})
    received: list[tuple[Message, bytes]] = []
    try:
        for message in outgoing:
            worker.send(message)
        async with asyncio.timeout(LIMIT_S):
            reason = await worker.run(lambda message, payload: received.append((message, payload)))
    finally:
        await worker.stop()
    with pytest.raises(ProcessLookupError):
        os.kill(worker.pid, 0)
    return reason, received


async def test_messages_go_both_ways_and_the_status_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    reason, received = await run_child("""
        send({"type": "ready", "saw": start}, b"payload")
        sys.exit(7)
    """, monkeypatch, tmp_path)
    assert reason == "exited with status 7"
    assert received == [({"type": "ready", "saw": {"type": "start", "stream": "s"}}, b"payload")]


async def test_death_by_signal_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    reason, _ = await run_child("os.kill(os.getpid(), signal.SIGSEGV)", monkeypatch, tmp_path)
    assert reason == "was ended by SIGSEGV"


async def test_silence_after_ready_ends_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(worker_process, "SILENCE_LIMIT_S", 0.4)
    reason, _ = await run_child("""
        send({"type": "ready"})
        time.sleep(60)
    """, monkeypatch, tmp_path)
    assert reason == "was silent for 0.4 s"


async def test_silence_before_ready_has_a_longer_limit(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(worker_process, "SILENCE_LIMIT_S", 0.2)
    monkeypatch.setattr(worker_process, "STARTUP_LIMIT_S", 15.0)
    reason, received = await run_child("""
        time.sleep(1)
        send({"type": "ready"})
        sys.exit(0)
    """, monkeypatch, tmp_path)
    assert reason == "exited with status 0"
    assert len(received) == 1


async def test_a_stall_of_the_server_is_not_held_against_the_worker(monkeypatch: pytest.MonkeyPatch,
                                                                   tmp_path: Path) -> None:
    monkeypatch.setattr(worker_process, "SILENCE_LIMIT_S", 1.0)
    stall = asyncio.get_running_loop().call_later(2.0, time.sleep, 2.0)
    reason, received = await run_child("""
        send({"type": "ready"})
        end = time.monotonic() + 6
        while time.monotonic() < end:
            send({"type": "stats"})
            time.sleep(0.1)
        sys.exit(5)
    """, monkeypatch, tmp_path)
    stall.cancel()
    assert reason == "exited with status 5"
    assert len(received) > 10


@pytest.mark.parametrize("garbage", [
    "connection.sendall(b'x' * 100)",
    "connection.sendall(b'\\x02\\0\\0\\0\\0\\0\\0\\0[]')",
    "connection.sendall(b'\\x02\\0\\0\\0\\0\\0\\0\\0{x')",
])
async def test_garbage_ends_it(garbage: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    reason, _ = await run_child(f"{garbage}\ntime.sleep(60)", monkeypatch, tmp_path)
    assert reason.startswith("sent a message that is wrong")


async def test_a_worker_that_does_not_read_blocks_nobody_and_gets_the_newest(monkeypatch: pytest.MonkeyPatch,
                                                                             tmp_path: Path) -> None:
    """Far more than a socket holds is sent before the child reads: it then finds little of it, and the newest last."""
    ballast = "x" * 100_000
    scenes = [{"type": "scene", "revision": revision, "ballast": ballast} for revision in range(500)]
    reason, received = await run_child("""
        seen = []
        while not seen or seen[-1] != 499:
            message, _ = receive_message(connection)
            if message["type"] == "scene":
                seen.append(message["revision"])
            time.sleep(0.05)
        send({"type": "ready", "seen": seen})
        sys.exit(0)
    """, monkeypatch, tmp_path, *scenes)
    assert reason == "exited with status 0"
    seen = received[0][0]["seen"]
    assert seen == sorted(seen)
    assert len(seen) < 20


async def test_stop_is_asked_for_first(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    script = tmp_path / "child.py"
    marker = tmp_path / "stopped"
    script.write_text(PRELUDE + textwrap.dedent(f"""
        send({{"type": "ready"}})
        while receive_message(connection)[0]["type"] != "stop":
            pass
        open({str(marker)!r}, "w").close()
    """))
    monkeypatch.setattr(worker_process, "WORKER_COMMAND", (sys.executable, str(script)))
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    worker = await WorkerProcess.start({"type": "start"})
    ready = asyncio.Event()
    running = asyncio.create_task(worker.run(lambda message, payload: ready.set()))
    await asyncio.wait_for(ready.wait(), LIMIT_S)
    running.cancel()
    await asyncio.wait([running])
    await worker.stop()
    await worker.stop()
    assert marker.exists()


async def test_stop_kills_what_does_not_listen(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    script = tmp_path / "child.py"
    script.write_text(PRELUDE + 'send({"type": "ready"})\ntime.sleep(60)')
    monkeypatch.setattr(worker_process, "WORKER_COMMAND", (sys.executable, str(script)))
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    worker = await WorkerProcess.start({"type": "start"})
    ready = asyncio.Event()
    running = asyncio.create_task(worker.run(lambda message, payload: ready.set()))
    await asyncio.wait_for(ready.wait(), LIMIT_S)
    running.cancel()
    await asyncio.wait([running])
    await worker.stop()
    with pytest.raises(ProcessLookupError):
        os.kill(worker.pid, 0)


async def test_a_program_that_is_not_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker_process, "WORKER_COMMAND", ("/no/such/program",))
    with pytest.raises(FileNotFoundError):
        await WorkerProcess.start({"type": "start"})

"""Freed memory goes back to the system, and what is there at the start is in no collection."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import random

import pytest

from server import memory


async def test_free_heap_is_given_back(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "CHECK_EVERY_S", 0.05)
    packets = [bytes(1250) for _ in range(60_000)]
    random.Random(1).shuffle(packets)
    del packets[2000:]          # what stays lies everywhere: the C library cannot shrink its heap at the end
    held = memory._resident_bytes()
    giving_back = asyncio.create_task(memory.give_back_memory())
    try:
        async with asyncio.timeout(10):
            while memory._resident_bytes() > held - 20_000_000:  # noqa: ASYNC110 - the kernel tells nobody
                await asyncio.sleep(0.02)
    finally:
        giving_back.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await giving_back
    assert len(packets) == 2000


def test_what_is_there_at_the_start_is_in_no_collection() -> None:
    try:
        memory.settle()
        assert gc.get_freeze_count() > 10_000
        assert len(gc.get_objects()) < 1000
    finally:
        gc.unfreeze()

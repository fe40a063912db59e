from __future__ import annotations

import asyncio
from dataclasses import dataclass, field

import pytest

from server.delivery.fanout import MAX_QUEUED_FRAMES, EncodedFrame, FanOut, Taker


@dataclass
class Calls:
    keyframes: int = 0
    counts: list[int] = field(default_factory=list)


def fanout_with_calls() -> tuple[FanOut, Calls]:
    calls = Calls()

    def request_keyframe() -> None:
        calls.keyframes += 1

    fanout = FanOut(request_keyframe=request_keyframe, takers_changed=lambda: calls.counts.append(len(fanout)))
    return fanout, calls


def frame(number: int, *, keyframe: bool = False) -> EncodedFrame:
    return EncodedFrame(b"\0\0\0\1\x65", number, keyframe=keyframe, decoded_at=0.0)


async def take(viewer: Taker, count: int) -> list[int]:
    return [(await asyncio.wait_for(viewer.next_frame(), 5)).timestamp for _ in range(count)]


async def queued(viewer: Taker) -> list[int]:
    """Everything that lies in the viewer's queue."""
    numbers = []
    while True:
        try:
            numbers.append((await asyncio.wait_for(viewer.next_frame(), 0.05)).timestamp)
        except TimeoutError:
            return numbers


async def test_every_viewer_gets_the_same_packet() -> None:
    fanout, _ = fanout_with_calls()
    one, two = fanout.join(), fanout.join()
    fanout.publish(frame(1, keyframe=True))
    assert await one.next_frame() is await two.next_frame()
    assert fanout.delivered == 2


async def test_a_viewer_starts_at_a_keyframe_which_is_requested() -> None:
    fanout, calls = fanout_with_calls()
    viewer = fanout.join()
    assert calls.keyframes == 1
    for number in range(3):
        fanout.publish(frame(number))
    fanout.publish(frame(3, keyframe=True))
    fanout.publish(frame(4))
    assert await take(viewer, 2) == [3, 4]
    assert viewer.dropped == 0


async def test_overflow_cuts_to_the_next_keyframe_and_counts() -> None:
    fanout, calls = fanout_with_calls()
    viewer = fanout.join()
    fanout.publish(frame(0, keyframe=True))
    for number in range(1, MAX_QUEUED_FRAMES + 3):     # full, then three too many
        fanout.publish(frame(number))
    assert calls.keyframes == 2
    fanout.publish(frame(100, keyframe=True))
    fanout.publish(frame(101))
    assert await queued(viewer) == [100, 101]
    assert viewer.dropped == fanout.dropped == MAX_QUEUED_FRAMES + 3


async def test_overflow_at_a_keyframe_goes_on_with_it() -> None:
    fanout, calls = fanout_with_calls()
    viewer = fanout.join()
    for number in range(MAX_QUEUED_FRAMES):
        fanout.publish(frame(number, keyframe=number == 0))
    fanout.publish(frame(500, keyframe=True))
    assert calls.keyframes == 1
    assert await queued(viewer) == [500]
    assert viewer.dropped == MAX_QUEUED_FRAMES


async def test_a_viewer_that_never_reads_disturbs_nobody() -> None:
    fanout, _ = fanout_with_calls()
    silent, reading = fanout.join(), fanout.join()
    received: list[int] = []
    for number in range(5 * MAX_QUEUED_FRAMES):
        fanout.publish(frame(number, keyframe=number == 0))
        received += await take(reading, 1)
    assert received == list(range(5 * MAX_QUEUED_FRAMES))
    assert reading.dropped == 0
    assert silent.dropped == 5 * MAX_QUEUED_FRAMES      # nothing is queued: no keyframe came since
    assert await queued(silent) == []


async def test_after_the_encoder_is_replaced_the_next_packet_is_a_keyframe() -> None:
    fanout, calls = fanout_with_calls()
    viewer = fanout.join()
    fanout.publish(frame(1, keyframe=True))
    fanout.encoder_replaced()
    assert calls.keyframes == 2
    fanout.publish(frame(2))
    fanout.publish(frame(3, keyframe=True))
    assert await take(viewer, 2) == [1, 3]
    assert viewer.dropped == 0


async def test_leaving_keeps_the_count_and_is_idempotent() -> None:
    fanout, calls = fanout_with_calls()
    viewer = fanout.join()
    fanout.publish(frame(1, keyframe=True))
    await viewer.next_frame()
    fanout.leave(viewer)
    fanout.leave(viewer)
    assert (len(fanout), fanout.delivered, calls.counts) == (0, 1, [1, 0])
    fanout.publish(frame(2, keyframe=True))
    with pytest.raises(TimeoutError):
        await asyncio.wait_for(viewer.next_frame(), 0.05)

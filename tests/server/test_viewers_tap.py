"""The tap of `make bench-viewers` in a real peer: fails when aiortc or aioice no longer works as it expects."""

from __future__ import annotations

import time
from collections.abc import AsyncIterator
from typing import Any

import pytest_asyncio
from aiortc.rtp import RtcpRtpfbPacket
from sender_pair import Pair, access_units, connected_pair, until

from server.bench.viewers_rtp import RtpCount
from server.bench.viewers_tap import Tap
from server.delivery.fanout import EncodedFrame

STEP = 3000


@pytest_asyncio.fixture
async def pair() -> AsyncIterator[Pair]:
    async with connected_pair() as connected:
        yield connected


@pytest_asyncio.fixture
async def tap(pair: Pair) -> AsyncIterator[Tap]:
    """The receiver of the pair is also the one that makes the offer; RTX is in the answer."""
    payload_type = pair.sender._rtx_payload_type
    tapping = Tap(pair.receiver, f"a=rtpmap:{payload_type} rtx/90000", RtpCount(time.time(), 30.0))
    yield tapping
    tapping.close()


def publish(pair: Pair, unit: bytes, number: int, *, keyframe: bool) -> None:
    pair.tracks.publish("full/h264", EncodedFrame(unit, number * STEP, keyframe=keyframe, decoded_at=time.monotonic()))


async def test_whole_frames_and_keyframes_are_counted(pair: Pair, tap: Tap) -> None:
    units = access_units(5, keyframe_interval=5)
    for number, unit in enumerate(units):
        publish(pair, unit, number, keyframe=number == 0)
        await until(lambda number=number: tap.count.frames == number + 1)
    assert (tap.count.keyframes, tap.count.incomplete, tap.count.late) == (1, 0, 0)
    assert tap.count.packets > 5 * 10
    assert sum(map(len, units)) < tap.count.bytes
    assert not pair.rtp, "aiortc has worked on these packets too"


async def test_what_is_lost_is_asked_for_and_reported(pair: Pair, tap: Tap) -> None:
    """One packet does not leave; RTX brings it."""
    feedback: list[Any] = []
    handle = pair.sender._handle_rtcp_packet

    async def heard(packet: Any) -> None:
        feedback.append(packet)
        await handle(packet)

    vars(pair.sender)["_handle_rtcp_packet"] = heard
    lose_the_third_packet(pair)
    units = access_units(2, keyframe_interval=2)
    for number, unit in enumerate(units):
        publish(pair, unit, number, keyframe=number == 0)
    await until(lambda: tap.count.frames == 2)
    assert tap.count.retransmitted >= 1
    assert any(isinstance(packet, RtcpRtpfbPacket) for packet in feedback), "no NACK was sent"
    await until(lambda: any(getattr(packet, "reports", None) for packet in feedback))
    report = next(packet.reports[0] for packet in feedback if getattr(packet, "reports", None))
    assert report.ssrc == pair.sender._ssrc
    assert report.highest_sequence == tap.count.highest
    assert report.packets_lost == 1
    await until(lambda: tap.count.sender_reports_ms)


def lose_the_third_packet(pair: Pair) -> None:
    transport: Any = pair.sender.transport
    send, media = transport._send_rtp, []

    async def losing(data: bytes) -> None:
        if data[1] & 127 == pair.sender._payload_type:
            media.append(data)
            if len(media) == 3:
                return
        await send(data)

    vars(transport)["_send_rtp"] = losing

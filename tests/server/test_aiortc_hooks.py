"""Each hook against a real pair of aiortc peers: these tests fail when aiortc no longer works as the hooks expect."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator

import pytest
import pytest_asyncio
from aiortc import RTCRtpSender, rtcpeerconnection, rtcrtpreceiver
from aiortc.rtp import RTCP_PSFB_FIR, RtcpPsfbPacket
from sender_pair import Pair, access_units, connected_pair, until

from server.delivery import aiortc_hooks
from server.demo.keyframe_decoder import KeyframeDecoder, is_keyframe

FIRST_TIMESTAMP = 4294960000        # wraps after a few frames


@pytest_asyncio.fixture
async def pair() -> AsyncIterator[Pair]:
    async with connected_pair() as connected:
        yield connected


async def test_rtp_timestamps_are_the_packets_own(pair: Pair) -> None:
    sent = [FIRST_TIMESTAMP + 3000 * number for number in range(6)]
    for unit, timestamp in zip(access_units(6), sent, strict=True):
        await pair.send(unit, timestamp)
    assert list(dict.fromkeys(packet.timestamp for packet in pair.rtp)) == [timestamp & 0xFFFFFFFF for timestamp in sent]


async def test_pli_reaches_our_callback(pair: Pair) -> None:
    await pair.send(access_units(1)[0], 0)
    await pair.receiver._send_rtcp_pli(pair.sender._ssrc)
    await until(lambda: pair.keyframe_requests)
    assert (len(pair.keyframe_requests), pair.feed.reception.keyframe_requests) == (1, 1)


async def test_fir_reaches_our_callback(pair: Pair) -> None:
    request = RtcpPsfbPacket(fmt=RTCP_PSFB_FIR, ssrc=1, media_ssrc=pair.sender._ssrc, fci=bytes(8))
    await pair.receiver._send_rtcp(request)
    await until(lambda: pair.keyframe_requests)
    assert (len(pair.keyframe_requests), pair.feed.reception.keyframe_requests) == (1, 1)


async def test_nack_of_a_packet_older_than_aiortcs_own_history_is_answered(pair: Pair) -> None:
    for number, unit in enumerate(access_units(8)):
        await pair.send(unit, 3000 * number)
    assert len(pair.rtp) > 250
    first, count = pair.rtp[0], len(pair.rtp)
    await pair.receiver._send_rtcp_nack(pair.sender._ssrc, [first.sequence_number])
    await until(lambda: len(pair.rtp) > count)
    repeated = pair.rtp[count]
    assert first.sequence_number.to_bytes(2) + first.payload in (
        repeated.payload, repeated.sequence_number.to_bytes(2) + repeated.payload)     # with or without RTX


async def test_ssrcs_stay_random(pair: Pair) -> None:
    assert pair.sender._ssrc != pair.sender._rtx_ssrc
    assert pair.sender._ssrc > 0


@pytest.mark.parametrize("name", ["_handle_rtcp_packet", "_run_rtp"])
def test_install_refuses_a_changed_sender(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(RTCRtpSender, name)
    with pytest.raises(RuntimeError, match=r"expected version 1\.16"):
        aiortc_hooks.install()


def test_install_refuses_a_connection_that_makes_its_senders_elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rtcpeerconnection.RTCPeerConnection, "_RTCPeerConnection__createTransceiver", lambda self: None)
    with pytest.raises(RuntimeError, match=r"expected version 1\.16"):
        aiortc_hooks.install()


async def test_a_receiver_uses_the_decoder_that_it_is_given(pair: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rtcrtpreceiver, "get_decoder", rtcrtpreceiver.get_decoder)     # put back at the end
    decoder = KeyframeDecoder()
    aiortc_hooks.decode_with(lambda codec: decoder)
    units = access_units(4, keyframe_interval=4)
    assert [is_keyframe(unit) for unit in units] == [True, False, False, False]
    for number, unit in enumerate(units):
        await pair.send(unit, 3000 * number)
    await until(lambda: decoder.units >= 3)     # the last one waits for a packet after it
    picture = await pair.receiver.track.recv()
    assert (picture.width, picture.height) == (320, 160)
    with pytest.raises(TimeoutError):
        await asyncio.wait_for(pair.receiver.track.recv(), 0.3)     # only the keyframe is decoded

"""What the sender puts on the wire: paced frames, reports on the stream's clock, retransmissions within limits."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator

import pytest
import pytest_asyncio
from aiortc import RTCCertificate, RTCDtlsTransport, RTCIceGatherer, RTCIceTransport
from aiortc.codecs import HEADER_EXTENSIONS
from aiortc.rtcrtpparameters import RTCRtpCodecParameters, RTCRtpHeaderExtensionParameters, RTCRtpSendParameters
from aiortc.rtp import RTCP_PSFB_APP, RtcpPsfbPacket, RtcpRrPacket, RtcpSrPacket, pack_remb_fci
from sender_pair import Pair, access_units, connected_pair, until

from server.delivery.fanout import EncodedFrame
from server.delivery.feed import FeedTrack
from server.delivery.sender import PLAYOUT_DELAY, PacketSender
from server.delivery.subscription import Choice, PictureFeed, SoundFeed
from server.delivery.tracks import Tracks
from server.renditions import AUDIO

INTERVAL_S = 1 / 30
TICKS = 3000


@pytest_asyncio.fixture
async def pair() -> AsyncIterator[Pair]:
    async with connected_pair() as connected:
        yield connected


def large_frame(timestamp: int) -> EncodedFrame:
    return EncodedFrame(b"\0\0\0\1\x65" + bytes(range(1, 251)) * 1000, timestamp, keyframe=True, decoded_at=time.monotonic())


async def test_a_large_frame_is_spread_over_the_time_to_the_next_one(pair: Pair) -> None:
    """By the sender's own time stamps: when packets arrive here depends on what else the loop has to do."""
    for number in range(3):
        pair.tracks.publish("full/h264", large_frame(number * TICKS))
        await until(lambda number=number: sum(packet.marker for packet in pair.rtp) == number + 1)
    last = [packet for packet in pair.rtp if packet.timestamp == 2 * TICKS]
    assert len(last) > 150
    times = [packet.extensions.abs_send_time / 2**18 for packet in last]
    assert (times[-1] - times[0]) % 64 > 0.5 * INTERVAL_S
    bursts = len(set(times))
    assert bursts >= 8
    assert len(last) / bursts < 25


async def test_a_small_frame_leaves_at_once(pair: Pair) -> None:
    for number in range(3):
        await pair.send(b"\0\0\0\1\x65" + bytes(range(1, 101)) * 60, number * TICKS)
    last = [packet for packet in pair.rtp if packet.timestamp == 2 * TICKS]
    assert 4 <= len(last) <= 8
    assert len({packet.extensions.abs_send_time for packet in last}) == 1


@pytest.mark.parametrize(("with_sound", "most"), [(False, 0), (True, 50)])
async def test_pictures_without_sound_are_not_to_be_held_back(pair: Pair, with_sound: bool, most: int) -> None:
    if with_sound:
        pair.feed.sound = SoundFeed(pair.tracks)
        waiting = asyncio.create_task(pair.feed.sound.next_frame())
        await asyncio.sleep(0.01)
        pair.tracks.publish(AUDIO, EncodedFrame(b"x", 0, keyframe=True, decoded_at=0.0))
        await waiting
    await pair.send(access_units(1)[0], 0)
    number = next(extension.id for extension in HEADER_EXTENSIONS["video"] if extension.uri == PLAYOUT_DELAY)
    assert bytes([number << 4 | 2, 0, 0, most]) in pair.sender._extensions()
    assert [extension.id for kind in HEADER_EXTENSIONS.values() for extension in kind].count(number) == 1


async def test_sender_reports_tell_when_the_frame_was_captured(pair: Pair) -> None:
    """Not when it was sent: this one was captured half a second earlier."""
    reports: list[RtcpSrPacket] = []
    handle = pair.receiver._handle_rtcp_packet

    async def record(packet: object) -> None:
        if isinstance(packet, RtcpSrPacket):
            reports.append(packet)
        await handle(packet)    # type: ignore[arg-type]

    pair.receiver._handle_rtcp_packet = record      # type: ignore[method-assign]
    captured_at, wall = time.monotonic() - 0.5, time.time() - 0.5
    pair.tracks.publish("full/h264", EncodedFrame(access_units(1)[0], 5 * 2**32 + 70, keyframe=True, decoded_at=captured_at))
    await until(lambda: reports)
    info = reports[0].sender_info
    assert info.rtp_timestamp == 70
    assert info.ntp_timestamp / 2**32 - 2_208_988_800 == pytest.approx(wall, abs=0.1)


async def test_reports_and_estimates_reach_the_feed(pair: Pair) -> None:
    for number, unit in enumerate(access_units(4)):
        await pair.send(unit, number * TICKS)
    await until(lambda: pair.feed.reception.rtt_s is not None)
    assert 0 <= pair.feed.reception.rtt_s < 5
    remb = RtcpPsfbPacket(fmt=RTCP_PSFB_APP, ssrc=1, media_ssrc=0, fci=pack_remb_fci(2_500_000, [pair.sender._ssrc]))
    await pair.receiver._send_rtcp(remb)
    await until(lambda: pair.feed.reception.remb_bps)
    assert pair.feed.reception.remb_bps == pytest.approx(2_500_000, rel=0.01)


async def test_nacks_beyond_the_allowance_are_left_alone(pair: Pair) -> None:
    units = access_units(3)
    for number, unit in enumerate(units):
        await pair.send(unit, number * TICKS)
    sent, lost = len(pair.rtp), [packet.sequence_number for packet in pair.rtp]
    for _ in range(20):
        await pair.receiver._send_rtcp_nack(pair.sender._ssrc, lost)
    await until(lambda: pair.feed.reception.nacked >= 20 * sent)
    await asyncio.sleep(0.2)
    assert 0 < pair.feed.reception.packets_resent < 10 * sent
    assert pair.feed.reception.bytes_resent < 100_000 + 0.36 * pair.feed.reception.bytes_sent


async def test_without_rtx_what_srtp_would_refuse_is_passed_over(pair: Pair) -> None:
    """And the numbers after it in the same NACK are answered."""
    pair.sender._rtx_payload_type = -1
    for number in range(6):
        await pair.send(b"\0\0\0\1\x65" + bytes(range(1, 251)) * 1040, number * TICKS)
    numbers = [packet.sequence_number for packet in pair.rtp]
    assert len(numbers) > 1100
    await pair.receiver._send_rtcp_nack(pair.sender._ssrc, [numbers[0], numbers[-1]])
    await until(lambda: pair.feed.reception.nacked == 2)
    await until(lambda: pair.feed.reception.packets_resent == 1)


@pytest.mark.parametrize(("mid", "kept"), [("0", True), ("x" * 16, True), ("x" * 36, False)])
async def test_a_media_id_too_long_for_its_header_is_left_out(mid: str, kept: bool) -> None:
    tracks = Tracks(request_keyframe=lambda track: None, demand_changed=lambda: None)
    feed = PictureFeed(tracks, ["full"], "h264", Choice(0, 0), lambda seconds: None)
    transport = RTCDtlsTransport(RTCIceTransport(RTCIceGatherer([])), [RTCCertificate.generateCertificate()])
    sender = PacketSender(FeedTrack("video", feed), transport)
    await sender.send(RTCRtpSendParameters(
        codecs=[RTCRtpCodecParameters(mimeType="video/H264", clockRate=90000, payloadType=97)], muxId=mid,
        headerExtensions=[RTCRtpHeaderExtensionParameters(id=1, uri="urn:ietf:params:rtp-hdrext:sdes:mid")]))
    assert (mid.encode() in sender._extensions()) == kept
    await sender.stop()


async def test_a_report_of_others_is_not_ours(pair: Pair) -> None:
    await pair.sender._handle_rtcp_packet(RtcpRrPacket(ssrc=1, reports=[]))
    assert pair.feed.reception.heard_at is None

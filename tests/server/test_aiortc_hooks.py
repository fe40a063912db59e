"""Each hook against a real pair of aiortc peers: these tests fail when aiortc no longer works as the hooks expect."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass, field
from fractions import Fraction

import av
import numpy as np
import pytest
import pytest_asyncio
from aiortc import RTCConfiguration, RTCPeerConnection, RTCRtpReceiver, RTCRtpSender, rtcpeerconnection, rtcrtpreceiver
from aiortc.rtp import RTCP_PSFB_FIR, RtcpPsfbPacket, RtpPacket

from server.delivery import aiortc_hooks
from server.delivery.fanout import EncodedFrame
from server.delivery.feed import FeedTrack
from server.delivery.sender import PacketSender
from server.delivery.subscription import Choice, PictureFeed
from server.delivery.tracks import Tracks
from server.delivery.whep import _with_retransmission
from server.demo.keyframe_decoder import KeyframeDecoder, is_keyframe

FIRST_TIMESTAMP = 4294960000        # wraps after a few frames
LIMIT_S = 20.0


def access_units(count: int, keyframe_interval: int = 1) -> list[bytes]:
    """H.264 of noise, so that one picture makes dozens of RTP packets."""
    encoder = av.CodecContext.create("libx264", "w")
    encoder.width, encoder.height, encoder.pix_fmt = 320, 160, "yuv420p"
    encoder.time_base, encoder.framerate = Fraction(1, 30), Fraction(30)
    encoder.options = {"preset": "ultrafast", "tune": "zerolatency", "qp": "10", "g": str(keyframe_interval)}
    encoder.profile = "Baseline"
    noise = np.random.default_rng(1)
    units = []
    for number in range(count):
        frame = av.VideoFrame.from_ndarray(noise.integers(0, 256, (240, 320), np.uint8), format="yuv420p")
        frame.pts = number
        units += [bytes(packet) for packet in encoder.encode(frame)]
    return units


@dataclass
class Pair:
    """A sender with hooks and a receiver, connected."""

    tracks: Tracks
    sender: PacketSender
    feed: PictureFeed
    receiver: RTCRtpReceiver
    keyframe_requests: list[float]
    rtp: list[RtpPacket] = field(default_factory=list)

    async def send(self, unit: bytes, timestamp: int) -> None:
        """Send one access unit and wait for its last packet: both peers share this loop, and a receiver that is not
        served loses what its socket's buffer cannot hold."""
        before = self._ends()
        self.tracks.publish("full/h264", EncodedFrame(unit, timestamp, keyframe=True, decoded_at=time.monotonic()))
        await until(lambda: self._ends() > before)

    def _ends(self) -> int:
        return sum(packet.marker for packet in self.rtp)


async def until(condition: Callable[[], object]) -> None:
    async with asyncio.timeout(LIMIT_S):
        while not condition():  # noqa: ASYNC110 - the condition is aiortc's, which tells nobody
            await asyncio.sleep(0.01)


@pytest_asyncio.fixture
async def pair() -> AsyncIterator[Pair]:
    aiortc_hooks.install()
    requests: list[float] = []
    tracks = Tracks(request_keyframe=lambda track: requests.append(time.monotonic()), demand_changed=lambda: None)
    ours = RTCPeerConnection(RTCConfiguration(iceServers=[]))
    theirs = RTCPeerConnection(RTCConfiguration(iceServers=[]))
    try:
        receiving = theirs.addTransceiver("video", direction="recvonly")
        await theirs.setLocalDescription(await theirs.createOffer())
        feed = PictureFeed(tracks, ["full", "low"], "h264", Choice(0, 1), lambda seconds: None)
        sending = ours.addTransceiver(FeedTrack("video", feed), direction="sendonly")
        sending.setCodecPreferences(_with_retransmission("h264"))
        await ours.setRemoteDescription(theirs.localDescription)
        await ours.setLocalDescription()
        connected = Pair(tracks, sending.sender, feed, receiving.receiver, requests)
        handle = receiving.receiver._handle_rtp_packet

        async def record(packet: RtpPacket, arrival_time_ms: int) -> None:
            connected.rtp.append(packet)
            await handle(packet, arrival_time_ms)

        receiving.receiver._handle_rtp_packet = record      # type: ignore[method-assign]
        await theirs.setRemoteDescription(ours.localDescription)
        await until(lambda: tracks.viewers == 1)
        requests.clear()        # the one for joining
        yield connected
    finally:
        await ours.close()
        await theirs.close()


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

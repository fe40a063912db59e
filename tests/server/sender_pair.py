"""A sender of ours and a receiver of aiortc's, connected."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from fractions import Fraction

import av
import numpy as np
from aiortc import RTCConfiguration, RTCPeerConnection, RTCRtpReceiver
from aiortc.rtp import RtpPacket

from server.delivery import aiortc_hooks
from server.delivery.codecs import with_retransmission
from server.delivery.fanout import EncodedFrame
from server.delivery.feed import FeedTrack
from server.delivery.sender import PacketSender
from server.delivery.subscription import Choice, PictureFeed
from server.delivery.tracks import Tracks

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


@asynccontextmanager
async def connected_pair() -> AsyncIterator[Pair]:
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
        sending.setCodecPreferences(with_retransmission("h264"))
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



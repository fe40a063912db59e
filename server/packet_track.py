"""The track that hands one viewer's shared packets to aiortc, which packs them without encoding."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import cast

import av
from aiortc import MediaStreamTrack
from aiortc.mediastreams import VIDEO_TIME_BASE, MediaStreamError

from server.fanout import EncodedFrame, FanOut, Viewer


def shared_packet(access_unit: bytes, timestamp: int) -> av.Packet[av.VideoStream]:
    """An `av.Packet` of one Annex B access unit whose RTP timestamp will be `timestamp` (90 kHz, modulo 2^32)."""
    packet = cast("av.Packet[av.VideoStream]", av.Packet(access_unit))
    packet.pts = timestamp & 0xFFFFFFFF
    packet.time_base = VIDEO_TIME_BASE
    return packet


class PacketTrack(MediaStreamTrack):
    """Joins the fan-out when aiortc first asks for media, once the viewer is connected: no queue fills before."""

    kind = "video"

    def __init__(self, fanout: FanOut, delivered: Callable[[float], None]) -> None:
        """`delivered` is told, per packet, the seconds from the decoded source frame to the hand-over to WebRTC."""
        super().__init__()
        self._fanout = fanout
        self._delivered = delivered
        self._viewer: Viewer | None = None

    async def recv(self) -> av.Packet[av.VideoStream]:
        if self.readyState != "live":
            raise MediaStreamError
        if self._viewer is None:
            self._viewer = self._fanout.join()
        frame: EncodedFrame = await self._viewer.next_frame()
        self._delivered(time.monotonic() - frame.decoded_at)
        return frame.packet

    def stop(self) -> None:
        if self._viewer is not None:
            self._fanout.leave(self._viewer)
        super().stop()

"""The track that hands one viewer's shared packets to aiortc, which packs them without encoding."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import cast

import av
from aiortc import MediaStreamTrack
from aiortc.mediastreams import VIDEO_TIME_BASE, MediaStreamError

from server.delivery.fanout import EncodedFrame, Taker
from server.delivery.tracks import Tracks


def shared_packet(access_unit: bytes, timestamp: int) -> av.Packet[av.VideoStream]:
    """An `av.Packet` of one Annex B access unit whose RTP timestamp will be `timestamp` (90 kHz, modulo 2^32)."""
    packet = cast("av.Packet[av.VideoStream]", av.Packet(access_unit))
    packet.pts = timestamp & 0xFFFFFFFF
    packet.time_base = VIDEO_TIME_BASE
    return packet


class PacketTrack(MediaStreamTrack):
    """Joins the fan-out when aiortc first asks for media, once the viewer is connected: no queue fills before."""

    kind = "video"

    def __init__(self, tracks: Tracks, track: str, delivered: Callable[[float], None]) -> None:
        """`delivered` is told, per packet, the seconds from the decoded source frame to the hand-over to WebRTC."""
        super().__init__()
        self._tracks = tracks
        self._fanout = tracks.fanout(track)
        self._delivered = delivered
        self._taker: Taker | None = None

    async def recv(self) -> av.Packet[av.VideoStream]:
        if self.readyState != "live":
            raise MediaStreamError
        if self._taker is None:
            self._taker = self._fanout.join()
            self._tracks.viewer_joined()
        frame: EncodedFrame = await self._taker.next_frame()
        self._delivered(time.monotonic() - frame.decoded_at)
        return shared_packet(frame.data, frame.timestamp)

    def stop(self) -> None:
        if self._taker is not None and self.readyState == "live":
            self._fanout.leave(self._taker)
            self._tracks.viewer_left()
        super().stop()

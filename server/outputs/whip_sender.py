"""Hands the stream's packets to aiortc, for one peer connection of a WHIP client."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable
from fractions import Fraction
from typing import Any

import av
from aiortc import MediaStreamTrack, RTCPeerConnection, RTCRtpCodecCapability, RTCRtpSender
from aiortc.mediastreams import MediaStreamError

from server.delivery import aiortc_hooks

MAX_QUEUED = 32
VIDEO_TIME_BASE = Fraction(1, 90_000)
AUDIO_TIME_BASE = Fraction(1, 48_000)


class PushTrack(MediaStreamTrack):
    """Fed by `push`; cut to the next keyframe when aiortc is slower than that."""

    def __init__(self, kind: str, request_keyframe: Callable[[], None]) -> None:
        self.kind = kind
        super().__init__()
        self._request_keyframe = request_keyframe
        self._time_base = VIDEO_TIME_BASE if kind == "video" else AUDIO_TIME_BASE
        self._queue: deque[tuple[int, bytes]] = deque()
        self._filled = asyncio.Event()
        self._needs_keyframe = True

    def push(self, timestamp: int, data: bytes, *, keyframe: bool) -> bool:
        """Returns whether the packet will go out."""
        if len(self._queue) >= MAX_QUEUED:
            self._queue.clear()
            self._needs_keyframe = True
            self._request_keyframe()
        if self._needs_keyframe and not keyframe:
            return False
        self._needs_keyframe = False
        self._queue.append((timestamp, data))
        self._filled.set()
        return True

    async def recv(self) -> Any:
        if self.readyState != "live":
            raise MediaStreamError
        while not self._queue:
            self._filled.clear()
            await self._filled.wait()
        timestamp, data = self._queue.popleft()
        packet: Any = av.Packet(data)
        packet.pts = timestamp & 0xFFFFFFFF
        packet.time_base = self._time_base
        return packet


def add_tracks(connection: RTCPeerConnection, request_keyframe: Callable[[], None], *, sound: bool) -> dict[str, PushTrack]:
    """Video as H.264 and, if there is sound, Opus; to be called before the offer is made. PLI and FIR call `request_keyframe`."""
    tracks = {kind: PushTrack(kind, request_keyframe) for kind in (("video", "audio") if sound else ("video",))}
    for kind, track in tracks.items():
        transceiver = connection.addTransceiver(track, direction="sendonly")
        if kind == "video":
            transceiver.setCodecPreferences(_h264_with_retransmission())
            aiortc_hooks.on_keyframe_request(transceiver.sender, request_keyframe)
    return tracks


def _h264_with_retransmission() -> list[RTCRtpCodecCapability]:
    codecs = RTCRtpSender.getCapabilities("video").codecs
    h264 = [codec for codec in codecs if codec.mimeType == "video/H264"]
    h264.sort(key=lambda codec: codec.parameters.get("profile-level-id") != "42e01f")
    return h264 + [codec for codec in codecs if codec.mimeType == "video/rtx"]

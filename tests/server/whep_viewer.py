"""A WHEP viewer of the tests: a real aiortc peer that receives and decodes."""

from __future__ import annotations

import asyncio
import re
from types import TracebackType
from typing import Any

import httpx
from aiortc import RTCConfiguration, RTCPeerConnection, RTCSessionDescription
from aiortc.rtp import RtpPacket

RECEIVE_LIMIT_S = 30.0


class WhepViewer:
    """`async with WhepViewer(url) as viewer: frame = await viewer.next_frame()`."""

    def __init__(self, base_url: str, stream: str = "live", *, hide_address: bool = False) -> None:
        self.http = httpx.AsyncClient(base_url=base_url, timeout=30)
        self.connection = RTCPeerConnection(RTCConfiguration(iceServers=[]))
        self.receiver = self.connection.addTransceiver("video", direction="recvonly").receiver
        self.rtp: list[RtpPacket] = []
        self.session_url = ""
        self.etag = ""
        self._endpoint = f"/whep/{stream}"
        self._hide_address = hide_address

    async def __aenter__(self) -> WhepViewer:
        try:
            await self.connect()
        except BaseException:
            await self.close()
            raise
        return self

    async def __aexit__(self, kind: type[BaseException] | None, error: BaseException | None,
                        trace: TracebackType | None) -> None:
        await self.close()

    async def offer(self) -> str:
        await self.connection.setLocalDescription(await self.connection.createOffer())
        offer = str(self.connection.localDescription.sdp)
        return hide_addresses(offer) if self._hide_address else offer

    async def connect(self) -> None:
        self._record_rtp()
        response = await self.http.post(self._endpoint, content=await self.offer(),
                                        headers={"Content-Type": "application/sdp"})
        assert response.status_code == 201, response.text
        self.session_url, self.etag = response.headers["Location"], response.headers["ETag"]
        await self.connection.setRemoteDescription(RTCSessionDescription(response.text, "answer"))

    async def next_frame(self) -> Any:
        """The next decoded picture."""
        return await asyncio.wait_for(self.receiver.track.recv(), RECEIVE_LIMIT_S)

    def keyframe_timestamps(self) -> list[int]:
        """RTP timestamps of the keyframes that have begun to arrive: an SPS stands in front of each."""
        return list(dict.fromkeys(packet.timestamp for packet in self.rtp if _nal_type(packet.payload) == 7))

    async def new_keyframe(self) -> None:
        """Wait for the next keyframe to arrive."""
        known = len(self.keyframe_timestamps())
        async with asyncio.timeout(RECEIVE_LIMIT_S):
            while len(self.keyframe_timestamps()) == known:  # noqa: ASYNC110
                await asyncio.sleep(0.02)

    async def close(self) -> None:
        await self.connection.close()
        await self.http.aclose()

    def _record_rtp(self) -> None:
        handle = self.receiver._handle_rtp_packet

        async def record(packet: RtpPacket, arrival_time_ms: int) -> None:
            self.rtp.append(packet)
            await handle(packet, arrival_time_ms)

        self.receiver._handle_rtp_packet = record  # type: ignore[method-assign]


def hide_addresses(offer: str) -> str:
    """The offer with the candidates' addresses replaced by an mDNS name, as browsers do it, that nobody answers to."""
    return re.sub(r"(?m)^(a=candidate:\S+ \d \S+ \d+ )\S+", r"\g<1>8d4a7c1e-0000-4000-8000-000000000000.local", offer)


def _nal_type(payload: bytes) -> int:
    """Of the first NAL unit in an RTP payload, also inside an aggregation packet (STAP-A, type 24)."""
    nal_type = payload[0] & 31
    return payload[3] & 31 if nal_type == 24 and len(payload) > 3 else nal_type

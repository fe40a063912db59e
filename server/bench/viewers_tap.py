"""RTP taken from a real aiortc peer before aiortc works on it, and what a receiver has to say put in its name.

ICE, DTLS and the SRTP keys are the peer's own. SRTP leaves headers in clear, so the payload is decrypted only where it matters:
of each frame's first packet, and of what is sent again. aiortc's own way of a packet costs the machine several times as much,
and the service that is measured runs beside it. aiortc still sends the receiver reports, from the counters here; NACK and PLI
follow from what is missing. There is no estimate of the bandwidth (REMB).

Reaches into aiortc 1.16 and aioice 0.13, which tests/server/test_viewers_tap.py would notice.
"""

from __future__ import annotations

import asyncio
import re
import socket
import struct
import time
from collections.abc import Callable
from typing import Any

from aiortc import RTCRtpReceiver, clock
from aiortc.rtp import AnyRtcpPacket, RtcpSrPacket, RtpPacket

from server.bench.viewers_rtp import RtpCount

RECEIVE_BUFFER = 4 << 20        # bytes; all viewers wait for one process, which a burst of a keyframe's packets must not overrun
REPEAT_EVERY_S = 0.1            # of a NACK, and of the look for what is to be given up
PLI_EVERY_S = 0.5
_RTX_NUMBER = 2                 # bytes of the original sequence number in front of the payload, RFC 4588
_SPS, _STAP_A = 7, 24
_HEADER = struct.Struct("!BBHII")


class Tap:
    """Counts what comes to a video receiver until `close`; `answer` is the SDP that it was negotiated by."""

    def __init__(self, receiver: RTCRtpReceiver, answer: str, count: RtpCount) -> None:
        self.count = count
        self._receiver: Any = receiver
        self._dtls: Any = receiver.transport
        self._retransmissions = {int(number) for number in re.findall(r"a=rtpmap:(\d+) rtx/", answer)}
        self._ssrc: int | None = None
        self._sending: set[asyncio.Task[None]] = set()
        self._pli_at = 0.0
        for protocol in self._dtls.transport._connection._protocols:
            _enlarge_buffer(protocol.transport)
            vars(protocol)["datagram_received"] = self._filtered(protocol.datagram_received)
        self._aiortc_takes_rtcp = self._receiver._handle_rtcp_packet
        vars(self._receiver)["_handle_rtcp_packet"] = self._rtcp
        self._timer = asyncio.get_running_loop().call_later(REPEAT_EVERY_S, self._look)

    def close(self) -> None:
        self._timer.cancel()

    def _filtered(self, aioice_takes: Callable[[Any, Any], None]) -> Callable[[bytes, Any], None]:
        def take(data: bytes, address: Any) -> None:
            # RFC 7983 and 5761: 128..191 is RTP or RTCP, of which RTCP has 192..223 in its second byte
            if len(data) > 12 and 128 <= data[0] <= 191 and not 192 <= data[1] <= 223 and self._dtls._rx_srtp is not None:
                self._rtp(data)
            else:
                aioice_takes(data, address)
        return take

    def _rtp(self, data: bytes) -> None:
        _, kind, sequence, timestamp, ssrc = _HEADER.unpack_from(data)
        count = self.count
        count.bytes += len(data)
        marker, payload_type = kind >= 128, kind & 127
        if payload_type in self._retransmissions:
            packet = RtpPacket.parse(self._dtls._rx_srtp.unprotect(data))
            if len(packet.payload) <= _RTX_NUMBER:      # padding
                return
            count.retransmitted += 1
            sequence = int.from_bytes(packet.payload[:_RTX_NUMBER], "big")
            count.packet(sequence, timestamp, marker=marker, keyframe=_begins_keyframe(packet.payload[_RTX_NUMBER:]))
            return
        if self._ssrc is None:
            self._ssrc = ssrc
            self._receiver._RTCRtpReceiver__remote_streams[ssrc] = _Reported(count)
        keyframe = False
        if count.payload_matters(sequence, timestamp):
            keyframe = _begins_keyframe(RtpPacket.parse(self._dtls._rx_srtp.unprotect(data)).payload)
        if count.packet(sequence, timestamp, marker=marker, keyframe=keyframe):
            self._ask_again()

    async def _rtcp(self, packet: AnyRtcpPacket) -> None:
        if isinstance(packet, RtcpSrPacket) and packet.sender_info.packet_count:
            wall = clock.datetime_from_ntp(packet.sender_info.ntp_timestamp).timestamp()
            self.count.sender_report(wall, packet.sender_info.rtp_timestamp)
        await self._aiortc_takes_rtcp(packet)

    def _look(self) -> None:
        now = time.monotonic()
        self.count.give_up(now)
        if self._ssrc is not None:
            if self.count.missing():
                self._ask_again()
            if self.count.needs_keyframe and now - self._pli_at > PLI_EVERY_S:
                self._pli_at = now
                self._send(self._receiver._send_rtcp_pli(self._ssrc))
        self._timer = asyncio.get_running_loop().call_later(REPEAT_EVERY_S, self._look)

    def _ask_again(self) -> None:
        self._send(self._receiver._send_rtcp_nack(self._ssrc, sorted(self.count.missing())))

    def _send(self, sending: Any) -> None:
        task = asyncio.ensure_future(sending)
        self._sending.add(task)
        task.add_done_callback(self._sending.discard)


class _Reported:
    """What aiortc asks its own statistics for when it sends a receiver report (RFC 3550, 6.4.1)."""

    def __init__(self, count: RtpCount) -> None:
        self._count = count
        self._before = (0, 0)

    @property
    def packets_received(self) -> int:
        """Without those sent again, which have an SSRC of their own."""
        return self._count.packets - self._count.retransmitted

    @property
    def fraction_lost(self) -> int:
        """Of 256, since the last report."""
        now = (self._count.expected, self.packets_received)
        expected, received = now[0] - self._before[0], now[1] - self._before[1]
        self._before = now
        return min(255, max(0, (expected - received) * 256 // expected)) if expected > 0 else 0

    @property
    def packets_lost(self) -> int:
        return max(-(1 << 23), min((1 << 23) - 1, self._count.expected - self.packets_received))

    @property
    def max_seq(self) -> int:
        return self._count.highest & 0xFFFFFFFF

    @property
    def jitter(self) -> int:
        return int(self._count.jitter_ticks)


def _begins_keyframe(payload: bytes) -> bool:
    """H.264: an SPS stands in front of each, alone or first in an aggregation packet (RFC 6184)."""
    kind = payload[0] & 31 if payload else 0
    return (payload[3] & 31 if kind == _STAP_A and len(payload) > 3 else kind) == _SPS


def _enlarge_buffer(transport: asyncio.DatagramTransport) -> None:
    transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)

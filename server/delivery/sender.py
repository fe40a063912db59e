"""The RTP sender of one viewer's track, in the place of aiortc's: shared payloads, paced, retransmitted for a second and more.

aiortc's own keeps 128 packets for retransmission, sends a frame of any size in one burst, does not tell anybody of a viewer's loss,
and makes its sender reports from the time of sending. This one is a subclass so that aiortc's peer connection takes it; everything
that runs is here. What it relies on in aiortc is checked by `aiortc_hooks.install`.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import random
import struct
import time
from collections.abc import Callable, Coroutine
from math import ceil
from typing import Any

from aiortc import RTCRtpSender
from aiortc.codecs import is_rtx
from aiortc.mediastreams import MediaStreamError
from aiortc.rtcdtlstransport import RTCDtlsTransport
from aiortc.rtcrtpparameters import RTCRtpSendParameters
from aiortc.rtp import (
    RTCP_PSFB_APP,
    RTCP_PSFB_FIR,
    RTCP_PSFB_PLI,
    RTCP_RTPFB_NACK,
    AnyRtcpPacket,
    RtcpByePacket,
    RtcpPsfbPacket,
    RtcpRrPacket,
    RtcpRtpfbPacket,
    RtcpSdesPacket,
    RtcpSenderInfo,
    RtcpSourceInfo,
    RtcpSrPacket,
    unpack_remb_fci,
)
from aiortc.stats import RTCStatsReport

from server.delivery.feed import FeedTrack
from server.delivery.payloads import payloads
from server.delivery.retransmission import RetransmissionAllowance
from server.delivery.sent_frames import SentFrame, SentFrames

logger = logging.getLogger(__name__)

BURST_PACKETS = 8           # leave together: 38 Mbps, a small load for an access point
BURST_INTERVAL_S = 0.002
PACED_SHARE = 0.8           # of the time to the next frame: the last packets of one must not meet the first of the next
SRTP_WINDOW = 1024          # of aiortc's session: numbers further back cannot be sent again by themselves
LONGEST_FRAME_S = 1 / 24    # a stream slower than that does not pace its frames more slowly
REPORT_EVERY_S = (0.5, 1.5)  # RFC 3550: at random, so that many senders do not report at once

LONGEST_EXTENSION = 16      # bytes, with one-byte headers

_ABS_SEND_TIME = "http://www.webrtc.org/experiments/rtp-hdrext/abs-send-time"
_MID = "urn:ietf:params:rtp-hdrext:sdes:mid"
PLAYOUT_DELAY = "http://www.webrtc.org/experiments/rtp-hdrext/playout-delay"
# Least and most, in 12 bits each, of 10 ms. Zero and zero has browsers show a picture as soon as it is whole.
_AT_ONCE, _WITH_SOUND = bytes(3), (50).to_bytes(3)


class PacketSender(RTCRtpSender):
    """Sends what the `FeedTrack`'s feed gives. Its owner stops it through the peer connection."""

    def __init__(self, track: FeedTrack, transport: RTCDtlsTransport) -> None:
        super().__init__(track, transport)
        self._feed = track.feed
        self._feed_track = track
        self._tasks: list[asyncio.Task[None]] = []
        self._cname = ""
        self._clock_rate = 90_000
        self._payload_type = self._rtx_payload_type = -1
        self._mid_extension = b""
        self._send_time_id = self._playout_delay_id = 0
        # In the lower half, as RFC 3711 implementations lose track of a wrap among the first packets.
        self._next_sequence, self._next_rtx_sequence = random.getrandbits(15), random.getrandbits(15)
        self._sent = SentFrames()
        self._allowance = RetransmissionAllowance()
        self._newest_ticks: int | None = None
        self._frame_interval_s = LONGEST_FRAME_S
        self._reports_sent: dict[int, float] = {}   # middle 32 bits of a report's NTP time: when it was sent

    # --- aiortc's peer connection calls ----------------------------------------------------------------------------

    async def send(self, parameters: RTCRtpSendParameters) -> None:
        """Begin to send as negotiated. Later calls do nothing."""
        if self._tasks:
            return
        codec = parameters.codecs[0]
        assert codec.payloadType is not None
        self._cname, self._clock_rate, self._payload_type = parameters.rtcp.cname or "", codec.clockRate, codec.payloadType
        for other in parameters.codecs:
            if is_rtx(other) and other.parameters["apt"] == codec.payloadType and other.payloadType is not None:
                self._rtx_payload_type = other.payloadType
        for extension in parameters.headerExtensions:
            if extension.uri == _MID and 1 <= len(parameters.muxId.encode()) <= LONGEST_EXTENSION:
                self._mid_extension = _extension(extension.id, parameters.muxId.encode())
            elif extension.uri == _ABS_SEND_TIME:
                self._send_time_id = extension.id
            elif extension.uri == PLAYOUT_DELAY:
                self._playout_delay_id = extension.id
        self.transport._register_rtp_sender(self, parameters)
        self._tasks = [asyncio.create_task(self._run(step)) for step in (self._send_media, self._send_reports)]

    async def stop(self) -> None:
        """End for good, with a BYE if the transport still takes it."""
        if not self._tasks:
            return
        self.transport._unregister_rtp_sender(self)
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await self._send_rtcp_quietly([RtcpByePacket(sources=[self._ssrc])])

    async def getStats(self) -> RTCStatsReport:  # noqa: N802 - aiortc's name
        """The transport's only; this sender's own are in `feed.reception`."""
        report = RTCStatsReport()
        report.update(self.transport._get_stats())
        return report

    async def _handle_rtcp_packet(self, packet: AnyRtcpPacket) -> None:
        now, reception = time.monotonic(), self._feed.reception
        if isinstance(packet, RtcpRrPacket | RtcpSrPacket):
            for report in packet.reports:
                if report.ssrc == self._ssrc:
                    sent_at = self._reports_sent.get(report.lsr)
                    rtt_s = None if sent_at is None or not report.dlsr else now - sent_at - report.dlsr / 65536
                    reception.report(now, report.packets_lost, report.highest_sequence, rtt_s)
        elif isinstance(packet, RtcpRtpfbPacket) and packet.fmt == RTCP_RTPFB_NACK:
            for sequence_number in packet.lost:
                await self._send_again(sequence_number)
        elif isinstance(packet, RtcpPsfbPacket) and packet.fmt in (RTCP_PSFB_PLI, RTCP_PSFB_FIR):
            reception.keyframe_requests += 1
            self._feed.request_keyframe()
        elif isinstance(packet, RtcpPsfbPacket) and packet.fmt == RTCP_PSFB_APP:
            self._take_estimate(packet, now)

    def _take_estimate(self, packet: RtcpPsfbPacket, now: float) -> None:
        try:
            bps, ssrcs = unpack_remb_fci(packet.fci)
        except ValueError:
            return
        if self._ssrc in ssrcs:
            self._feed.reception.estimate(now, bps)

    # --- media -----------------------------------------------------------------------------------------------------

    async def _run(self, step: Callable[[], Coroutine[Any, Any, None]]) -> None:
        try:
            await step()
        except (ConnectionError, MediaStreamError):
            pass            # the connection is gone, its owner knows
        except Exception:
            logger.exception("a sender broke")
        finally:
            self._feed_track.stop()

    async def _send_media(self) -> None:
        while True:
            frame = await self._feed.next_frame()
            parts = payloads(frame, self._feed.codec)
            now, timestamp = time.monotonic(), frame.timestamp & 0xFFFFFFFF
            self._note_interval(frame.timestamp)
            first, self._next_sequence = self._next_sequence, self._next_sequence + len(parts)
            self._sent.add(SentFrame(first, parts, timestamp, now))
            self._allowance.media_sent(sum(map(len, parts)))
            await self._send_paced(parts, first, timestamp)

    def _note_interval(self, ticks: int) -> None:
        if self._newest_ticks is not None and ticks > self._newest_ticks:
            self._frame_interval_s = min((ticks - self._newest_ticks) / self._clock_rate, LONGEST_FRAME_S)
        self._newest_ticks = ticks

    async def _send_paced(self, parts: list[bytes], first: int, timestamp: int) -> None:
        """A few packets at a time; a large frame takes most of the time to the next one, a small one less."""
        bursts = max(1, int(PACED_SHARE * self._frame_interval_s / BURST_INTERVAL_S))
        size = max(BURST_PACKETS, ceil(len(parts) / bursts))
        start = time.monotonic()
        for number, at in enumerate(range(0, len(parts), size)):
            wait = start + number * BURST_INTERVAL_S - time.monotonic()
            if wait > 0:
                await asyncio.sleep(wait)
            extensions = self._extensions()
            for index in range(at, min(at + size, len(parts))):
                await self._send_packet(parts[index], self._payload_type, first + index, timestamp, self._ssrc,
                                        index == len(parts) - 1, extensions)
                self._feed.reception.packets_sent += 1
                self._feed.reception.bytes_sent += len(parts[index])

    async def _send_again(self, sequence_number: int) -> None:
        """Answer a NACK: by RTX (RFC 4588) where it was negotiated, else by the packet itself."""
        reception = self._feed.reception
        reception.nacked += 1
        if self._rtx_payload_type < 0 and (self._next_sequence - sequence_number) & 0xFFFF >= SRTP_WINDOW:
            return      # SRTP would refuse to protect it again
        found = self._sent.find(sequence_number)
        if found is None:
            return
        frame, index = found
        payload, last = frame.payloads[index], index == len(frame.payloads) - 1
        if not self._allowance.take(len(payload)):
            return
        if self._rtx_payload_type >= 0:
            number, self._next_rtx_sequence = self._next_rtx_sequence, self._next_rtx_sequence + 1
            await self._send_packet(struct.pack("!H", sequence_number) + payload, self._rtx_payload_type, number,
                                    frame.timestamp, self._rtx_ssrc, last, self._extensions())
        else:
            await self._send_packet(payload, self._payload_type, sequence_number, frame.timestamp, self._ssrc, last,
                                    self._extensions())
        reception.packets_resent += 1
        reception.bytes_resent += len(payload)

    async def _send_packet(self, payload: bytes, payload_type: int, sequence: int, timestamp: int, ssrc: int, marker: bool,
                           extensions: bytes) -> None:
        header = struct.pack("!BBHII", 0x90 if extensions else 0x80, marker << 7 | payload_type, sequence & 0xFFFF, timestamp, ssrc)
        await self.transport._send_rtp(b"".join((header, extensions, payload)))

    def _extensions(self) -> bytes:
        """RFC 8285, one-byte headers: the media id, the time of sending, from which the viewer estimates its bandwidth, and how
        long it may hold a picture back."""
        elements = self._mid_extension
        if self._playout_delay_id:
            elements += _extension(self._playout_delay_id, _AT_ONCE if self._feed.at_once else _WITH_SOUND)
        if self._send_time_id:
            elements += _extension(self._send_time_id, (int(time.monotonic() * (1 << 18)) & 0xFFFFFF).to_bytes(3))
        if not elements:
            return b""
        elements += bytes(-len(elements) % 4)
        return struct.pack("!HH", 0xBEDE, len(elements) // 4) + elements

    # --- reports ---------------------------------------------------------------------------------------------------

    async def _send_reports(self) -> None:
        """Say when what was sent last was captured: from that a receiver aligns sound and picture (RFC 3550, 6.4.1)."""
        while True:
            await asyncio.sleep(random.uniform(*REPORT_EVERY_S))
            if self._newest_ticks is None:
                continue
            ntp = self._feed.clock.ntp(self._newest_ticks, self._clock_rate)
            reception = self._feed.reception
            self._reports_sent[(ntp >> 16) & 0xFFFFFFFF] = time.monotonic()
            while len(self._reports_sent) > 8:
                self._reports_sent.pop(next(iter(self._reports_sent)))
            info = RtcpSenderInfo(ntp_timestamp=ntp, rtp_timestamp=self._newest_ticks & 0xFFFFFFFF,
                                  packet_count=reception.packets_sent & 0xFFFFFFFF, octet_count=reception.bytes_sent & 0xFFFFFFFF)
            names = [RtcpSourceInfo(ssrc=self._ssrc, items=[(1, self._cname.encode())])]
            await self._send_rtcp_quietly([RtcpSrPacket(ssrc=self._ssrc, sender_info=info), RtcpSdesPacket(chunks=names)])

    async def _send_rtcp_quietly(self, packets: list[AnyRtcpPacket]) -> None:
        with contextlib.suppress(ConnectionError):      # there may be no connection yet, or no more
            await self.transport._send_rtp(b"".join(bytes(packet) for packet in packets))


def _extension(number: int, value: bytes) -> bytes:
    return bytes([number << 4 | (len(value) - 1)]) + value

"""RTP payloads of an access unit: made once, by whichever viewer sends it first, and shared by all.

H.264 is packed by aiortc (RFC 6184: single NAL units, STAP-A, FU-A). VP8 has the shortest payload descriptor of RFC 7741, without a
picture id, so that a viewer may be switched between encoders. An Opus packet is its payload (RFC 7587).
"""

from __future__ import annotations

import av
from aiortc.codecs.h264 import H264Encoder
from aiortc.mediastreams import VIDEO_TIME_BASE

from server.delivery.fanout import EncodedFrame

MAX_PAYLOAD_BYTES = 1200    # leaves room for SRTP, TURN, IPv6 and a VPN's headers in 1280 bytes
_VP8_START, _VP8_MORE = b"\x10", b"\x00"

_h264 = H264Encoder()


def payloads(frame: EncodedFrame, codec: str) -> list[bytes]:
    """The frame's RTP payloads, none longer than aiortc's 1300 bytes; `codec` is `h264`, `vp8` or `opus`."""
    if frame.payloads is None:
        frame.payloads = _PACK[codec](frame.data)
    return frame.payloads


def _pack_h264(unit: bytes) -> list[bytes]:
    packet = av.Packet(unit)
    packet.pts, packet.time_base = 0, VIDEO_TIME_BASE
    return _h264.pack(packet)[0]


def _pack_vp8(frame: bytes) -> list[bytes]:
    step = MAX_PAYLOAD_BYTES - 1
    return [(_VP8_MORE if at else _VP8_START) + frame[at:at + step] for at in range(0, len(frame), step)]


def _pack_opus(packet: bytes) -> list[bytes]:
    return [packet]


_PACK = {"h264": _pack_h264, "vp8": _pack_vp8, "opus": _pack_opus}

"""What an H.264 byte stream says about itself."""

from __future__ import annotations

import io

import av
from av.container import InputContainer

_SPS, _PPS, _AUD = 7, 8, 9
_START = b"\0\0\1"


def split_parameter_sets(access_unit: bytes) -> tuple[bytes, bytes]:
    """The SPS and PPS at the front of an Annex B access unit, and the rest of it without access unit delimiter."""
    sets, position = bytearray(), 0
    while True:
        start = access_unit.find(_START, position)
        if start < 0:
            return bytes(sets), b""
        kind = access_unit[start + 3] & 31 if start + 3 < len(access_unit) else 0
        if kind not in (_SPS, _PPS, _AUD):
            return bytes(sets), b"\0" + access_unit[start:]
        position = access_unit.find(_START, start + 3)
        if position < 0:
            position = len(access_unit)
        if kind != _AUD:
            sets += b"\0" + access_unit[start:position].rstrip(b"\0")


def probe(keyframe: bytes) -> InputContainer:
    """An opened container whose one stream has geometry, colour tags and parameter sets of the keyframe: a template to mux by.

    Raises av.error.FFmpegError, ValueError when it is no H.264.
    """
    container = av.open(io.BytesIO(keyframe), "r", format="h264")
    if not container.streams.video or not container.streams.video[0].codec_context.width:
        container.close()
        raise ValueError("the stream's keyframe has no parameter sets")
    return container

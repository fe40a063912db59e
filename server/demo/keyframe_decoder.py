"""An H.264 decoder that counts every access unit and decodes keyframes alone.

The demo's viewer stands for a headset with a decoder of its own; decoding all that it receives would take a fifth of a core
away from the service that the demo measures.
"""

from __future__ import annotations

from aiortc.codecs.base import Decoder
from aiortc.codecs.h264 import H264Decoder
from aiortc.jitterbuffer import JitterFrame
from av.frame import Frame

_IDR_SLICE, _TYPE_BITS = 5, 0x1F
_START_CODE = b"\x00\x00\x01"


class KeyframeDecoder(Decoder):
    """`units` and `timestamp` (RTP, 90 kHz) tell what has come; only keyframes come out as pictures."""

    def __init__(self) -> None:
        self._decoder = H264Decoder()
        self.units = 0
        self.timestamp: int | None = None

    def decode(self, encoded_frame: JitterFrame) -> list[Frame]:
        self.units += 1
        self.timestamp = encoded_frame.timestamp
        return self._decoder.decode(encoded_frame) if is_keyframe(encoded_frame.data) else []


def is_keyframe(unit: bytes) -> bool:
    """Whether an access unit in Annex B has an IDR slice."""
    at = unit.find(_START_CODE)
    while 0 <= at < len(unit) - 3:
        kind = unit[at + 3] & _TYPE_BITS
        if kind <= _IDR_SLICE:      # slices come last, and all are of one kind
            return kind == _IDR_SLICE
        at = unit.find(_START_CODE, at + 3)
    return False

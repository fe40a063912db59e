"""Opus by libopus, for viewers over WebRTC."""

from __future__ import annotations

from fractions import Fraction

import av
from av.audio.codeccontext import AudioCodecContext
from av.audio.frame import AudioFrame

from server.worker.output_clock import SOUND_RATE
from server.worker.sound_timeline import Samples

BITRATE_BPS = 128_000
EXPECTED_LOSS_PERCENT = 5       # less prediction from packet to packet. In-band FEC is off: it would have music coded as speech


class OpusEncoder:
    """48 kHz stereo, a packet of 20 ms for each block of 960 samples, in the bitrate's steps (constrained VBR)."""

    def __init__(self) -> None:
        context = av.CodecContext.create("libopus", "w")
        assert isinstance(context, AudioCodecContext)
        context.sample_rate, context.layout, context.format = SOUND_RATE, "stereo", "s16"
        context.bit_rate = BITRATE_BPS
        context.time_base = Fraction(1, SOUND_RATE)
        context.options = {"application": "audio", "frame_duration": "20", "vbr": "constrained",
                           "packet_loss": str(EXPECTED_LOSS_PERCENT)}
        self._context = context

    def encode(self, block: Samples, tick: int) -> list[tuple[bytes, int]]:
        """Packets (RFC 6716), each with the tick of its first sample, which the encoder's delay puts before the block's."""
        frame = AudioFrame.from_ndarray(block.reshape(1, -1), format="s16", layout="stereo")
        frame.sample_rate, frame.pts, frame.time_base = SOUND_RATE, tick, Fraction(1, SOUND_RATE)
        return [(bytes(packet), packet.pts) for packet in self._context.encode(frame) if packet.pts is not None]

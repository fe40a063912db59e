"""The sound of an output: the stream's Opus packets as they are, or as AAC for containers whose players want that.

RTMP knows AAC only; in MP4 it is what editors, QuickTime and every phone play, which Opus in MP4 is not. RTSP carries Opus
(RFC 7587), and so does WebRTC.
"""

from __future__ import annotations

from fractions import Fraction
from typing import Any, Protocol

import av
from av.audio.frame import AudioFrame
from av.container import OutputContainer

SAMPLE_RATE = 48_000
TIME_BASE = Fraction(1, SAMPLE_RATE)
PACKET_SAMPLES = 960            # 20 ms
AAC_BITRATE_BPS = 128_000
LONGEST_SILENCE_S = 30          # a gap is filled with silence up to this; after a longer one the connection begins anew

Packet = Any        # av.Packet, generic in the stubs only


class Sound(Protocol):
    """One sound track of an output container."""

    def packets(self, samples: int, opus: bytes) -> list[Packet]:
        """What is to be muxed for an Opus packet at that time, in samples since the output's origin.

        Raises ValueError after a gap that cannot be filled.
        """
        ...


class CopiedOpus:
    """Opus as it is. The encoder that FFmpeg opens for the stream only writes the header."""

    def __init__(self, container: OutputContainer) -> None:
        self._stream = container.add_stream("libopus", rate=SAMPLE_RATE, layout="stereo")
        self._last = -1

    def packets(self, samples: int, opus: bytes) -> list[Packet]:
        if samples <= self._last:
            return []
        self._last = samples
        packet: Packet = av.Packet(opus)
        packet.pts = packet.dts = samples
        packet.duration = PACKET_SAMPLES
        packet.time_base = TIME_BASE
        packet.stream = self._stream
        return [packet]


class EncodedAac:
    """Opus decoded and encoded as AAC. Time is counted in samples, so that lost packets become silence and nothing drifts."""

    def __init__(self, container: OutputContainer) -> None:
        self._stream = container.add_stream("aac", rate=SAMPLE_RATE, layout="stereo", bit_rate=AAC_BITRATE_BPS)
        self._decoder = av.CodecContext.create("libopus", "r")
        self._decoder.sample_rate = SAMPLE_RATE
        self._decoder.layout = "stereo"
        self._next: int | None = None

    def packets(self, samples: int, opus: bytes) -> list[Packet]:
        if self._next is None:
            self._next = samples
        missing = samples - self._next
        if missing > LONGEST_SILENCE_S * SAMPLE_RATE:
            raise ValueError(f"the sound was away for {missing / SAMPLE_RATE:.0f} s")
        if missing < -PACKET_SAMPLES // 2:
            return []
        packets = []
        while missing >= PACKET_SAMPLES // 2:       # less is jitter
            silent = min(missing, SAMPLE_RATE)
            packets += self._encode(_silence(silent))
            missing -= silent
        for frame in self._decoder.decode(av.Packet(opus)):
            packets += self._encode(frame)
        # What AAC needs to get going comes before the first sample: players must not wait for a time below zero.
        return [packet for packet in packets if packet.pts is not None and packet.pts >= 0]

    def _encode(self, frame: AudioFrame) -> list[Packet]:
        assert self._next is not None
        frame.pts, frame.time_base = self._next, TIME_BASE
        self._next += frame.samples
        return list(self._stream.encode(frame))


def _silence(samples: int) -> AudioFrame:
    frame = AudioFrame(format="flt", layout="stereo", samples=samples)
    frame.sample_rate = SAMPLE_RATE
    for plane in frame.planes:
        plane.update(bytes(plane.buffer_size))
    return frame

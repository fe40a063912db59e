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
SILENT_OPUS = bytes((0xFC, 0xFF, 0xFE))     # RFC 6716: CELT, full band, stereo, one frame of 20 ms with nothing in it
AAC_BITRATE_BPS = 128_000
LONGEST_SILENCE_S = 30          # a gap is filled with silence up to this; after a longer one the connection begins anew

Packet = Any        # av.Packet, generic in the stubs only


class Sound(Protocol):
    """One sound track of an output container. Times are in samples since the output's origin.

    Both methods return what is to be muxed, and raise ValueError at a gap that is too long to be filled.
    """

    def packets(self, samples: int, opus: bytes) -> list[Packet]:
        """For the stream's Opus packet of that time."""
        ...

    def silence(self, until: int) -> list[Packet]:
        """For what has not come by then."""
        ...


class CopiedOpus:
    """Opus as it is. The encoder that FFmpeg opens for the stream only writes the header."""

    def __init__(self, container: OutputContainer) -> None:
        self._stream = container.add_stream("libopus", rate=SAMPLE_RATE, layout="stereo")
        self._next = 0

    def packets(self, samples: int, opus: bytes) -> list[Packet]:
        if samples < self._next - PACKET_SAMPLES // 2:
            return []
        silence = self.silence(samples)
        return [*silence, self._packet(max(samples, self._next), opus)]

    def silence(self, until: int) -> list[Packet]:
        _check_gap(until - self._next)
        return [self._packet(self._next, SILENT_OPUS) for _ in range((until - self._next) // PACKET_SAMPLES)]

    def _packet(self, samples: int, opus: bytes) -> Packet:
        self._next = samples + PACKET_SAMPLES
        packet: Packet = av.Packet(opus)
        packet.pts = packet.dts = samples
        packet.duration = PACKET_SAMPLES
        packet.time_base = TIME_BASE
        packet.stream = self._stream
        return packet


class EncodedAac:
    """Opus decoded and encoded as AAC. Time is counted in samples, so that lost packets become silence and nothing drifts."""

    def __init__(self, container: OutputContainer) -> None:
        self._stream = container.add_stream("aac", rate=SAMPLE_RATE, layout="stereo", bit_rate=AAC_BITRATE_BPS)
        self._decoder = av.CodecContext.create("libopus", "r")
        self._decoder.sample_rate = SAMPLE_RATE
        self._decoder.layout = "stereo"
        self._next = 0

    def packets(self, samples: int, opus: bytes) -> list[Packet]:
        if self._next == 0:
            self._next = min(samples, PACKET_SAMPLES)       # exactly, for all that follows is counted from here
        if samples < self._next - PACKET_SAMPLES // 2:
            return []
        packets = self.silence(samples) if samples >= self._next + PACKET_SAMPLES // 2 else []      # less is jitter
        for frame in self._decoder.decode(av.Packet(opus)):
            packets += self._encode(frame)
        return packets

    def silence(self, until: int) -> list[Packet]:
        _check_gap(until - self._next)
        packets = []
        while self._next < until:
            packets += self._encode(_silence(min(until - self._next, SAMPLE_RATE)))
        return packets

    def _encode(self, frame: AudioFrame) -> list[Packet]:
        frame.pts, frame.time_base = self._next, TIME_BASE
        self._next += frame.samples
        # What AAC needs to get going comes before the first sample: players must not wait for a time below zero.
        return [packet for packet in self._stream.encode(frame) if packet.pts is not None and packet.pts >= 0]


def _check_gap(samples: int) -> None:
    if samples > LONGEST_SILENCE_S * SAMPLE_RATE:
        raise ValueError(f"the sound was away for {samples / SAMPLE_RATE:.0f} s")


def _silence(samples: int) -> AudioFrame:
    frame = AudioFrame(format="s16", layout="stereo", samples=samples)      # as libopus decodes
    frame.sample_rate = SAMPLE_RATE
    for plane in frame.planes:
        plane.update(bytes(plane.buffer_size))
    return frame

"""The sound of a source, decoded beside its pictures, at the rate and layout that is encoded."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import av
import numpy as np
from av.audio.frame import AudioFrame
from av.audio.resampler import AudioResampler
from av.audio.stream import AudioStream
from av.packet import Packet
from numpy.typing import NDArray

from server.worker.output_clock import SOUND_RATE

logger = logging.getLogger(__name__)
MAX_FAILURES = 50       # packets one after another that do not decode: a second of AAC or G.711


@dataclass(frozen=True)
class Heard:
    """Stereo sound, (samples, 2) at 48 kHz; its time in the source in seconds (None: unknown), and when the decoder gave it."""

    samples: NDArray[np.int16]
    pts: float | None
    decoded_at: float


@dataclass(frozen=True)
class SoundInfo:
    codec: str
    sample_rate: int
    channels: int


class SoundDecoder:
    """Whatever is wrong with the sound stays in here: packets that do not decode are silence, and too many end the sound."""

    def __init__(self, stream: AudioStream) -> None:
        self._stream = stream
        self._resampler: AudioResampler | None = None
        self._failures = 0
        self.broken = stream.codec_context is None

    @property
    def info(self) -> SoundInfo:
        context = self._stream.codec_context
        if context is None:
            return SoundInfo("unknown", 0, 0)
        return SoundInfo(context.name, context.sample_rate, context.layout.nb_channels)

    def decode(self, packet: Packet[AudioStream]) -> list[tuple[NDArray[np.int16], float | None]]:
        """Samples and their time in the source."""
        if self.broken:
            return []
        heard, error = [], "nothing comes out"
        try:
            heard = [found for frame in packet.decode() for found in self._resampled(frame)]
        except (av.error.FFmpegError, OSError, ValueError) as reason:
            self._resampler = None      # it may be the format that has changed
            error = str(reason)
        self._judge(worked=bool(heard), error=error)
        return heard

    def _resampled(self, frame: AudioFrame) -> list[tuple[NDArray[np.int16], float | None]]:
        if self._resampler is None:
            self._resampler = AudioResampler("s16", "stereo", SOUND_RATE)
        return [(out.to_ndarray().astype(np.int16, copy=False).reshape(-1, 2), out.time) for out in self._resampler.resample(frame)]

    def _judge(self, *, worked: bool, error: str) -> None:
        self._failures = 0 if worked else self._failures + 1
        if self._failures == MAX_FAILURES:
            self.broken = True
            logger.warning("sound is given up after %d packets that do not decode: %s", MAX_FAILURES, error)

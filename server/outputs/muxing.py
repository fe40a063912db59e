"""Copies a stream's packets into an FFmpeg container: RTMP, RTSP or a file."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from typing import Any

import av
from av.container import OutputContainer

from server.outputs.h264 import probe, split_parameter_sets
from server.outputs.server_link import OutputFailedError
from server.outputs.sound import SAMPLE_RATE, Sound

CLOCK_RATE = 90_000
TIME_BASE = Fraction(1, CLOCK_RATE)
# The muxer puts pictures and sound in order of time; where the sound stays away, it holds a picture back no longer than this.
LONGEST_INTERLEAVING_US = 100_000


class Muxing:
    """One container with one video track and, if `make_sound` is given, one of sound. Time begins with the first picture.

    `target` is a URL or an object with `write`; it is opened by the first keyframe. Every method raises av.error.FFmpegError or
    OSError when the peer or the disk fails, and OutputFailedError when what follows does not fit the header.
    """

    def __init__(self, target: Any, container_format: str, options: dict[str, str],
                 make_sound: Callable[[OutputContainer], Sound] | None, *, sets_in_band: bool) -> None:
        self._target = target
        self._format = container_format
        self._options = {**options, "max_interleave_delta": str(LONGEST_INTERLEAVING_US)}
        self._make_sound = make_sound
        self._sets_in_band = sets_in_band
        self._parameter_sets = b""
        self._container: OutputContainer | None = None
        self._video: Any = None
        self._sound: Sound | None = None
        self._last = -1
        self.origin = 0                 # of the output's time, in ticks of the stream's 90 kHz clock

    @property
    def opened(self) -> bool:
        return self._container is not None

    @property
    def size(self) -> tuple[int, int]:
        return self._video.width, self._video.height

    def write_picture(self, timestamp: int, access_unit: bytes, *, keyframe: bool) -> float:
        """Returns the picture's time in seconds since the first one."""
        if keyframe:
            sets, rest = split_parameter_sets(access_unit)
            if self._container is None:
                self._open(access_unit, sets, timestamp)
            elif sets != self._parameter_sets:
                raise OutputFailedError("the encoder's parameters have changed", at_once=True)
            if not self._sets_in_band:
                access_unit = rest
        assert self._container is not None
        self._last = max(timestamp - self.origin, self._last + 1)
        packet: Any = av.Packet(access_unit)
        packet.pts = packet.dts = self._last
        packet.time_base = TIME_BASE
        packet.is_keyframe = keyframe
        packet.stream = self._video
        self._container.mux(packet)
        return self._last / CLOCK_RATE

    def write_sound(self, timestamp: int, opus: bytes) -> None:
        """`timestamp` in ticks of 48 kHz. What comes before the first picture is left out."""
        samples = timestamp - self.origin * SAMPLE_RATE // CLOCK_RATE
        if self._container is None or self._sound is None or samples < 0:
            return
        try:
            packets = self._sound.packets(samples, opus)
        except ValueError as error:
            if isinstance(error, av.error.FFmpegError):
                raise
            raise OutputFailedError(str(error), at_once=True) from None
        for packet in packets:
            self._container.mux(packet)

    def close(self) -> None:
        container, self._container = self._container, None
        if container is not None:
            container.close()

    def _open(self, keyframe: bytes, parameter_sets: bytes, timestamp: int) -> None:
        container = av.open(self._target, "w", format=self._format, container_options=self._options)
        with probe(keyframe) as template:
            self._video = container.add_stream_from_template(template.streams.video[0])
            if self._make_sound is not None:
                self._sound = self._make_sound(container)
            container.start_encoding()
        self._container, self._parameter_sets, self.origin = container, parameter_sets, timestamp

"""Copies a stream's packets into an FFmpeg container: RTMP, RTSP or a file."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from typing import Any

import av
from av.container import OutputContainer

from server.outputs.h264 import probe, split_parameter_sets
from server.outputs.server_link import OutputFailedError
from server.outputs.sound import SAMPLE_RATE, Packet, Sound

CLOCK_RATE = 90_000
TIME_BASE = Fraction(1, CLOCK_RATE)
# The muxer puts pictures and sound in order of time. Sound that has stopped, while pictures of so much time went by, is replaced
# by silence up to a little before the newest picture, or it would hold the pictures back; late sound does, up to a second.
SOUND_STOPPED_S = 0.3
SILENCE_BEHIND_S = 0.1
LONGEST_INTERLEAVING_US = 1_000_000


class Muxing:
    """One container with one video track and, if `make_sound` is given, one of sound. Time begins with the first picture written.

    `target` is a URL or an object with `write`. Every method raises av.error.FFmpegError or OSError when the peer or the disk
    fails, and OutputFailedError when what is to be written does not fit the header.
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
        self._last = -1                     # picture's time, in ticks since the origin
        self._sound_came_at = 0.0           # the last picture's seconds when sound came last
        self._origin: int | None = None     # of the output's time, in ticks of the stream's 90 kHz clock

    @property
    def opened(self) -> bool:
        return self._container is not None

    @property
    def begun(self) -> bool:
        """A picture has been written."""
        return self._origin is not None

    @property
    def size(self) -> tuple[int, int]:
        return self._video.width, self._video.height

    def open(self, keyframe: bytes) -> None:
        """Connect or create, and write the header by what the keyframe says. It is not written itself."""
        container = av.open(self._target, "w", format=self._format, container_options=self._options)
        with probe(keyframe) as template:
            self._video = container.add_stream_from_template(template.streams.video[0])
            if self._make_sound is not None:
                self._sound = self._make_sound(container)
            container.start_encoding()
        self._container, self._parameter_sets = container, split_parameter_sets(keyframe)[0]

    def write_picture(self, timestamp: int, access_unit: bytes, *, keyframe: bool) -> float:
        """The first one has to be a keyframe. Returns the picture's time in seconds since the first one."""
        assert self._container is not None
        if keyframe:
            sets, rest = split_parameter_sets(access_unit)
            if sets != self._parameter_sets:
                raise OutputFailedError("the encoder's parameters have changed", at_once=True)
            if not self._sets_in_band:
                access_unit = rest
        if self._origin is None:
            self._origin = timestamp
        self._last = max(timestamp - self._origin, self._last + 1)
        packet: Any = av.Packet(access_unit)
        packet.pts = packet.dts = self._last
        packet.time_base = TIME_BASE
        packet.is_keyframe = keyframe
        packet.stream = self._video
        self._container.mux(packet)
        seconds = self._last / CLOCK_RATE
        if self._sound is not None and seconds - self._sound_came_at > SOUND_STOPPED_S:
            self._mux_sound(lambda sound: sound.silence(int((seconds - SILENCE_BEHIND_S) * SAMPLE_RATE)))
        return seconds

    def write_sound(self, timestamp: int, opus: bytes) -> None:
        """`timestamp` in ticks of 48 kHz. What comes before the first picture is left out."""
        if self._sound is None or self._origin is None:
            return
        self._sound_came_at = self._last / CLOCK_RATE
        samples = timestamp - self._origin * SAMPLE_RATE // CLOCK_RATE
        if samples >= 0:
            self._mux_sound(lambda sound: sound.packets(samples, opus))

    def _mux_sound(self, make: Callable[[Sound], list[Packet]]) -> None:
        assert self._container is not None
        assert self._sound is not None
        try:
            packets = make(self._sound)
        except ValueError as error:
            if isinstance(error, av.error.FFmpegError):
                raise
            raise OutputFailedError(str(error), at_once=True) from None
        self._container.mux(packets)

    def close(self) -> None:
        container, self._container = self._container, None
        if container is not None:
            container.close()

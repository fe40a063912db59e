"""Opens what a stream pulls from: RTSP, RTMP (pulled, or listened for), a video file or an image, and decodes it.

FFmpeg's own time limits are set beside PyAV's, because either alone leaves some call without one.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, Protocol
from urllib.parse import unquote, urlsplit

import av
from av.audio.stream import AudioStream
from av.container import InputContainer
from av.video.frame import VideoFrame
from av.video.stream import VideoStream

from server.worker.sound_decoder import Heard, SoundDecoder, SoundInfo

OPEN_TIMEOUT_S = 5.0
READ_TIMEOUT_S = 5.0
IMAGE_FPS = 30
IMAGE_SUFFIXES = {".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff"}
NETWORK_PROTOCOLS = "rtsp,rtsps,rtp,srtp,udp,tcp,tls,rtmp,rtmps,rtmpt,crypto"
LISTEN_SCHEME = "rtmp-listen"


class SourceError(RuntimeError):
    """The source cannot be used; the message says why."""


@dataclass(frozen=True)
class Decoded:
    """A frame, its time in the source in seconds (None: unknown), when the decoder gave it, and its time on the stream's clock."""

    frame: VideoFrame
    pts: float | None
    decoded_at: float
    captured_at: float
    moment: float = 0.0


@dataclass(frozen=True)
class SourceInfo:
    width: int
    height: int
    fps: float
    codec: str
    pix_fmt: str
    audio: SoundInfo | None = None
    no_sound: bool = False      # there is some, but it does not decode


class Listener(Protocol):
    """Who takes the sound. Called by the thread that iterates the frames."""

    @property
    def wanted(self) -> bool: ...

    def hear(self, heard: Heard) -> None: ...


class Source:
    """One opened source. Iterate `frames`; close when done. Sound is decoded on the way, while the listener wants it."""

    def __init__(self, url: str, *, allow_files: bool, listener: Listener | None = None) -> None:
        self._path = local_path(url)
        if self._path is not None and not allow_files:
            raise SourceError(f"source {url!r} is a file, expected an rtsp, rtmp or {LISTEN_SCHEME} url")
        if self._path is not None and not self._path.is_file():
            raise SourceError(f"source file {str(self._path)!r} does not exist")
        self._url = url
        self._container = self._open()
        if not self._container.streams.video:
            self._container.close()
            raise SourceError("source has no video stream")
        self._stream: VideoStream = self._container.streams.video[0]
        self._stream.thread_type = "SLICE"  # frame threads would add a frame of delay each
        self._stream.codec_context.flags |= av.codec.context.Flags.low_delay
        self._listener = listener
        best = self._container.streams.best("audio", related=self._stream) if listener is not None else None
        self._sound_stream = best if isinstance(best, AudioStream) else None
        self._sound = SoundDecoder(self._sound_stream) if self._sound_stream is not None else None
        self._turn_s = 0.0      # what the time of a looped file has to be put forward

    def _open(self) -> InputContainer:
        started = time.monotonic()
        try:
            if self._path is not None:
                return av.open(str(self._path), timeout=(OPEN_TIMEOUT_S, READ_TIMEOUT_S))
            url, options = network_options(self._url)
            return av.open(url, options=options, timeout=(OPEN_TIMEOUT_S, READ_TIMEOUT_S))
        except (av.error.FFmpegError, OSError, ValueError) as error:
            # FFmpeg's protocols report what the interruption left them with, not that it was one
            late = time.monotonic() - started > OPEN_TIMEOUT_S - 0.2
            reason = f"no answer within {OPEN_TIMEOUT_S:g} s" if late else _reason(error)
            raise SourceError(f"source does not open: {reason}") from None

    @property
    def info(self) -> SourceInfo:
        context = self._stream.codec_context
        rate = self._stream.average_rate or self._stream.guessed_rate or Fraction(IMAGE_FPS)
        return SourceInfo(context.width, context.height, round(float(rate), 3), context.name, str(context.pix_fmt),
                          audio=None if self._sound is None else self._sound.info, no_sound=self.no_sound)

    @property
    def no_sound(self) -> bool:
        """Its sound has been given up."""
        return self._sound is not None and self._sound.broken

    def frames(self) -> Iterator[Decoded]:
        """Decoded frames in real time: the network's own, a file's by its timestamps, over and over."""
        if self._path is None:
            yield from self._live()
        elif self._path.suffix.lower() in IMAGE_SUFFIXES:
            yield from self._still()
        else:
            yield from self._loop()

    def _pictures(self) -> Iterator[VideoFrame]:
        """The frames of what is in the container, whose sound is handed on as it comes between them."""
        for packet in self._container.demux([stream for stream in (self._stream, self._sound_stream) if stream is not None]):
            if packet.stream is self._sound_stream:
                self._hear(packet)
            else:
                yield from self._stream.codec_context.decode(packet)

    def _hear(self, packet: av.Packet[Any]) -> None:
        if self._sound is None or self._listener is None or not self._listener.wanted:
            return
        for samples, time_s in self._sound.decode(packet):
            self._listener.hear(Heard(samples, None if time_s is None else time_s + self._turn_s, time.monotonic()))

    def _live(self) -> Iterator[Decoded]:
        try:
            for frame in self._pictures():
                yield Decoded(frame, frame.time, time.monotonic(), time.time())
        except (av.error.FFmpegError, OSError) as error:
            raise SourceError(f"source broke off: {_reason(error)}") from None
        raise SourceError("source ended")

    def _still(self) -> Iterator[Decoded]:
        try:
            frame = next(self._container.decode(self._stream))
        except (StopIteration, av.error.FFmpegError, OSError) as error:
            raise SourceError(f"image does not decode: {_reason(error)}") from None
        start = time.monotonic()
        index = 0
        while True:
            yield Decoded(frame, index / IMAGE_FPS, time.monotonic(), time.time())
            index = max(index + 1, int((time.monotonic() - start) * IMAGE_FPS))
            time.sleep(max(0.0, start + index / IMAGE_FPS - time.monotonic()))

    def _loop(self) -> Iterator[Decoded]:
        start, last, step = time.monotonic(), 0.0, 1 / IMAGE_FPS
        while True:
            count = 0
            try:
                for frame in self._pictures():
                    moment = self._turn_s + (frame.time if frame.time is not None else count * step)
                    if moment > last:
                        step, last = min(moment - last, 1.0), moment
                    time.sleep(max(0.0, min(start + moment - time.monotonic(), 1.0)))
                    yield Decoded(frame, moment, time.monotonic(), time.time())
                    count += 1
                self._container.seek(0)
            except (av.error.FFmpegError, OSError) as error:
                raise SourceError(f"file does not decode: {_reason(error)}") from None
            if count == 0:
                raise SourceError("file has no frames")
            self._turn_s = last + step

    def close(self) -> None:
        self._container.close()


def local_path(url: str) -> Path | None:
    """The path of a `file://` URL or a plain path; None for a URL of another scheme."""
    parts = urlsplit(url)
    if parts.scheme == "file":
        return Path(unquote(parts.path))
    return Path(url) if "://" not in url else None


def network_options(url: str) -> tuple[str, dict[str, str]]:
    """FFmpeg's URL and options. Raises SourceError for a scheme that is not supported."""
    scheme = urlsplit(url).scheme
    options = {"fflags": "nobuffer", "flags": "low_delay", "analyzeduration": "1000000", "probesize": "500000",
               "protocol_whitelist": NETWORK_PROTOCOLS}
    microseconds = str(int(READ_TIMEOUT_S * 1e6))
    if scheme in ("rtsp", "rtsps"):
        return url, {**options, "rtsp_transport": "tcp", "timeout": microseconds}
    if scheme in ("rtmp", "rtmps"):
        return url, {**options, "rtmp_live": "live", "rw_timeout": microseconds}
    if scheme == LISTEN_SCHEME:
        return url.replace(LISTEN_SCHEME, "rtmp", 1), {**options, "listen": "1"}
    raise SourceError(f"source scheme {scheme!r} is not supported, expected rtsp, rtsps, rtmp, rtmps or {LISTEN_SCHEME}")


def _reason(error: BaseException) -> str:
    if isinstance(error, av.error.ExitError | av.error.TimeoutError):
        return f"no answer within {READ_TIMEOUT_S:g} s"
    if isinstance(error, av.error.FFmpegError):
        return str(error.strerror).lower()
    return str(error).lower()

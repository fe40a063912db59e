"""`mr360 publish`: feeds a video file or a picture to an RTMP or RTSP server in real time.

H.264 is copied, so publishing the demo clip costs almost no processor time; anything else is encoded. Sound goes out beside copied
video as it is, if the server's protocol carries its codec. The first time stamp of the video is 0 and none ever jumps, not across
the loop either: the pts that a receiver sees are seconds since the start.
"""

from __future__ import annotations

import argparse
import signal
import sys
import threading
import time
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from types import FrameType
from typing import Any, Protocol, TypeAlias
from urllib.parse import urlsplit

import av
from av.audio.stream import AudioStream
from av.container import InputContainer, OutputContainer
from av.video.frame import PictureType
from av.video.stream import VideoStream

FORMATS = {"rtmp": "flv", "rtmps": "flv", "rtsp": "rtsp", "rtsps": "rtsp"}
_G711 = ("pcm_alaw", "pcm_mulaw")
SOUND_CODECS = {"flv": ("aac", "mp3", "mp3float", *_G711), "rtsp": ("aac", "libopus", "mp3", "mp3float", "opus", *_G711)}
LONGEST_WAIT = 100_000  # microseconds for which the muxer keeps video back when sound is missing
RETRY_PAUSE_S = 1.0
STOP_WITHIN_S = 2
PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg")
PICTURE_FPS, PICTURE_SECONDS = 30, 10

Packet: TypeAlias = "av.Packet[Any]"


class PublishError(ValueError):
    """The file or the URL cannot be used."""


class _Feed(Protocol):
    """Something to publish: `prepare` adds its stream to an output, `packets` goes through it once."""

    def prepare(self, output: OutputContainer) -> None: ...

    def packets(self, loop: bool) -> Iterator[Packet]: ...


def run_publish(args: argparse.Namespace) -> int:
    """Publish `args.file` to `args.url`, for ever with `args.loop`. Returns the exit status: 0, or 2 with one line."""
    stop = threading.Event()
    _stop_on_signals(stop)
    try:
        publish(Path(args.file), args.url, loop=args.loop, stop=stop)
    except (PublishError, OSError) as error:
        print(f"mr360 publish: {error}", file=sys.stderr)
        return 2
    return 0


def publish(file: Path, url: str, loop: bool, stop: threading.Event) -> None:
    """Publish until the end of the file or until `stop`; with `loop`, also start again whenever the server is lost.

    Raises PublishError for a file or URL that cannot be used and, without `loop`, when the server is lost.
    """
    scheme = urlsplit(url).scheme
    if scheme not in FORMATS:
        raise PublishError(f"url scheme of {url!r} is {scheme!r}, expected one of {', '.join(FORMATS)}")
    if not file.is_file():
        raise PublishError(f"file {str(file)!r} does not exist, expected a video or a picture")
    while not stop.is_set():
        with _open_input(file) as source:
            try:
                _send(_feed(source, file), url, loop, stop)
            except OSError as error:    # av.FFmpegError among them
                reason = getattr(error, "strerror", None) or error
                if not loop:
                    raise PublishError(f"server of {url!r} is lost: {str(reason).lower()}") from None
                print(f"mr360 publish: {url}: {str(reason).lower()}, trying again", file=sys.stderr, flush=True)
                stop.wait(RETRY_PAUSE_S)
                continue
        if not loop:
            return


def _send(feed: _Feed, url: str, loop: bool, stop: threading.Event) -> None:
    name = FORMATS[urlsplit(url).scheme]
    # Without flush_packets the end of a frame waits in a buffer for the next frame.
    options = {"max_interleave_delta": str(LONGEST_WAIT)}
    options |= {"rtsp_transport": "tcp"} if name == "rtsp" else {"flush_packets": "1"}
    with av.open(url, "w", format=name, options=options) as output:
        feed.prepare(output)
        started = 0.0
        for packet in feed.packets(loop):
            if packet.dts is None or packet.time_base is None:
                continue
            started = started or time.monotonic()
            due = started + float(packet.dts * packet.time_base)
            if stop.wait(max(due - time.monotonic(), 0)):
                return
            output.mux(packet)


def _open_input(file: Path) -> InputContainer:
    try:
        source = av.open(str(file))
    except av.FFmpegError as error:
        raise PublishError(f"file {str(file)!r} cannot be read: {str(error.strerror).lower()}") from None
    if not source.streams.video:
        source.close()
        raise PublishError(f"file {str(file)!r} has no video, expected a video or a picture")
    return source


def _feed(source: InputContainer, file: Path) -> _Feed:
    stream = source.streams.video[0]
    if file.suffix.lower() in PICTURE_SUFFIXES:
        return _Encoded(source, stream, picture=True)
    return _Copied(source, stream) if stream.codec.name == "h264" else _Encoded(source, stream, picture=False)


class _Copied:
    """Video and sound as they are. The video's length is the loop's: sound that is longer loses its end."""

    def __init__(self, source: InputContainer, stream: VideoStream) -> None:
        self._source, self._stream = source, stream
        best = source.streams.best("audio", related=stream)
        self._sound = best if isinstance(best, AudioStream) else None
        self._sent: dict[int, VideoStream | AudioStream] = {}

    def prepare(self, output: OutputContainer) -> None:
        self._sent = {self._stream.index: output.add_stream_from_template(self._stream)}
        if self._sound is None:
            return
        codec = self._sound.codec.name
        if codec in SOUND_CODECS[output.format.name]:
            self._sent[self._sound.index] = output.add_stream_from_template(self._sound)
        else:
            print(f"mr360 publish: sound codec {codec!r} is left out, expected one of "
                  f"{', '.join(SOUND_CODECS[output.format.name])}", file=sys.stderr, flush=True)

    def packets(self, loop: bool) -> Iterator[Packet]:
        base = self._stream.time_base
        if base is None:
            raise PublishError(f"file {self._source.name!r} has no time base, expected a video")
        spacing = 1 / (self._stream.average_rate or Fraction(30))
        first: Fraction | None = None
        offset = Fraction(0)        # all in seconds
        ends = dict.fromkeys(self._sent, Fraction(0))
        while True:
            for packet in self._source.demux([self._source.streams[index] for index in self._sent]):
                if packet.dts is None or packet.pts is None:
                    continue
                index, is_video = packet.stream_index, packet.stream_index == self._stream.index
                if first is None and is_video:
                    first = packet.dts * base
                    offset = -first
                start = packet.dts * packet.time_base + offset
                if first is None or (start < ends[index] and not is_video):
                    continue        # sound before the first picture, or what the last turn's sound has covered
                ends[index] = max(ends[index], start + ((packet.duration or 0) * packet.time_base or spacing))
                yield self._moved(packet, offset)
            if not loop or first is None:
                return
            self._source.seek(0)
            offset = ends[self._stream.index] - first

    def _moved(self, packet: Packet, offset: Fraction) -> Packet:
        assert packet.pts is not None
        assert packet.dts is not None
        by = round(offset / packet.time_base)
        packet.pts, packet.dts = packet.pts + by, packet.dts + by
        packet.stream = self._sent[packet.stream_index]
        return packet


class _Encoded:
    """Decodes and encodes; odd sizes lose their last row or column, which 4:2:0 cannot carry."""

    def __init__(self, source: InputContainer, stream: VideoStream, picture: bool) -> None:
        self._source, self._stream, self._picture = source, stream, picture
        self._rate = Fraction(PICTURE_FPS) if picture else stream.average_rate or Fraction(30)
        self._encoder: VideoStream | None = None

    def prepare(self, output: OutputContainer) -> None:
        seconds = max(round(float(self._rate)), 1)
        encoder = output.add_stream("libx264", rate=self._rate, options={
            "preset": "superfast", "tune": "zerolatency", "g": str(seconds), "crf": "18"})
        encoder.width, encoder.height = self._stream.width // 2 * 2, self._stream.height // 2 * 2
        encoder.pix_fmt = "yuv420p"
        self._encoder = encoder

    def packets(self, loop: bool) -> Iterator[Packet]:
        encoder = self._encoder
        assert encoder is not None
        for index, frame in enumerate(self._frames(loop)):
            frame.pts, frame.time_base = index, 1 / self._rate
            frame.pict_type = PictureType.NONE
            yield from encoder.encode(frame)
        yield from encoder.encode(None)

    def _frames(self, loop: bool) -> Iterator[av.VideoFrame]:
        """At the average rate: a picture's time stamps say nothing, and a looped file's start again."""
        width, height = self._stream.width // 2 * 2, self._stream.height // 2 * 2
        while True:
            for frame in self._source.decode(self._stream):
                count = PICTURE_FPS * PICTURE_SECONDS if self._picture else 1
                fitted = frame.reformat(width, height, "yuv420p")
                for _ in range(count):
                    yield fitted
            if not loop:
                return
            self._source.seek(0)


def _stop_on_signals(stop: threading.Event) -> None:
    def on_signal(number: int, frame: FrameType | None) -> None:
        stop.set()
        # A write into a server that does not read cannot be interrupted: let the kernel end it.
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(STOP_WITHIN_S)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, on_signal)

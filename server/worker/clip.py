"""Writes an H.264 clip with correct colour tags and spherical metadata; the file appears only when it is whole."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from types import TracebackType

import av
from av.video.stream import VideoStream

from renderer.frame import YuvFrame
from server.worker.picture import video_frame
from server.worker.spherical import add_spherical_metadata

TIME_BASE = Fraction(1, 90_000)


class ClipWriter:
    """`with ClipWriter(path, fps) as clip: clip.write(picture, seconds)`. On an exception nothing is left behind."""

    def __init__(self, path: Path, fps: float) -> None:
        self._path = path
        self._partial = path.with_name(f".{path.name}.partial")
        self._fps = Fraction(fps).limit_denominator(1001)
        self._container = av.open(str(self._partial), "w", format="mp4")
        self._stream: VideoStream | None = None
        self._first: float | None = None

    def __enter__(self) -> ClipWriter:
        return self

    def write(self, picture: YuvFrame, seconds: float) -> None:
        """Append a picture at that time; times must increase."""
        if self._stream is None:
            self._stream = self._open(picture)
        if self._first is None:
            self._first = seconds
        frame = video_frame(picture)
        frame.time_base = TIME_BASE
        frame.pts = round((seconds - self._first) / TIME_BASE)
        self._container.mux(self._stream.encode(frame))

    def _open(self, picture: YuvFrame) -> VideoStream:
        stream = self._container.add_stream("libx264", rate=self._fps)
        bt709 = picture.format.matrix == "bt709"
        stream.width, stream.height = picture.size
        stream.pix_fmt = "yuv420p"
        context = stream.codec_context
        context.time_base = TIME_BASE
        context.colorspace = context.color_primaries = context.color_trc = 1 if bt709 else 6
        context.color_range = 2 if picture.format.full_range else 1
        context.options = {"preset": "medium", "crf": "16"}
        return stream

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        try:
            if kind is None and self._stream is not None:
                self._container.mux(self._stream.encode(None))
        finally:
            self._container.close()
            if kind is not None or self._stream is None:
                self._partial.unlink(missing_ok=True)
        if kind is None and self._stream is not None:
            add_spherical_metadata(self._partial)
            self._partial.replace(self._path)

"""Between FFmpeg's frames and the renderer's: planes, colour tags, and the stream's fixed output geometry."""

from __future__ import annotations

import weakref
from collections import deque
from fractions import Fraction

import av
import numpy as np
from av.video.frame import VideoFrame
from av.video.reformatter import ColorRange, Colorspace, VideoReformatter
from numpy.typing import NDArray

from renderer.color import YuvFormat
from renderer.frame import YuvFrame
from server.worker.dither import dithered

DIRECT_FORMATS = {"yuv420p", "yuvj420p"}
MAX_WIDTH, MAX_HEIGHT = 8192, 4096
MIN_SIDE = 16
_BT601 = {5, 6}       # AVCOL_SPC_BT470BG, SMPTE170M
_PQ = 16              # AVCOL_TRC_SMPTE2084
_BT709 = 1
_MPEG, _JPEG = 1, 2   # AVCOL_RANGE_*


class PictureError(ValueError):
    """A frame that cannot be processed."""


def output_size(width: int, height: int) -> tuple[int, int]:
    """The even size at which a source is processed. Raises PictureError when it is out of bounds."""
    if not (MIN_SIDE <= width <= MAX_WIDTH and MIN_SIDE <= height <= MAX_HEIGHT):
        raise PictureError(f"picture is {width}x{height}, expected {MIN_SIDE}x{MIN_SIDE} to {MAX_WIDTH}x{MAX_HEIGHT}")
    return width - width % 2, height - height % 2


def picture_flags(width: int, height: int, output: tuple[int, int], pix_fmt: str) -> list[str]:
    """What is unusual about a source, for the stream's state."""
    flags = []
    if abs(width - 2 * height) > 0.01 * width:
        flags.append("not_2_to_1")
    if width % 2 or height % 2:
        flags.append("odd_size")
    if (width - width % 2, height - height % 2) != output:
        flags.append("scaled")
    if pix_fmt not in DIRECT_FORMATS:
        flags.append("converted")
    return flags


def yuv_format(frame: VideoFrame) -> YuvFormat:
    """Matrix and range by the tags; untagged means BT.709 limited from 720 lines up, BT.601 limited below."""
    space, color_range = int(frame.colorspace), int(frame.color_range)
    bt601 = space in _BT601 or (space != _BT709 and frame.height < 720)
    full = color_range == _JPEG or (color_range != _MPEG and frame.format.name.startswith("yuvj"))
    return YuvFormat("bt601" if bt601 else "bt709", full)


class PictureReader:
    """Turns decoded frames into 8-bit 4:2:0 planes of one size. Only unusual formats and sizes go through swscale; codes of more
    than 8 bits are dithered."""

    def __init__(self, size: tuple[int, int]) -> None:
        self.size = size
        self._reformatter = VideoReformatter()
        self._codes: list[NDArray[np.uint8]] = []

    def read(self, frame: VideoFrame) -> YuvFrame:
        """Planes that are valid until the next call; copy to keep. Raises PictureError for a format that cannot be converted."""
        if int(frame.color_trc) == _PQ:     # whose codes would be taken for a display signal of another curve
            raise PictureError("transfer 'smpte2084' (PQ) is not supported, expected BT.709, sRGB, BT.601 or HLG")
        layout = YuvFormat("bt709", False) if _is_rgb(frame) else yuv_format(frame)
        depth = _kept_bits(frame)
        wanted = "yuv420p" if depth == 8 else f"yuv420p{depth}le"
        if frame.format.name not in (DIRECT_FORMATS if depth == 8 else {wanted}) or (frame.width, frame.height) != self.size:
            frame = self._converted(frame, wanted)
        self._kept = frame      # the planes point into it
        if depth > 8:
            return self._dithered(frame, depth, layout)
        return YuvFrame(_plane(frame, 0), _plane(frame, 1), _plane(frame, 2), layout)

    def _converted(self, frame: VideoFrame, wanted: str) -> VideoFrame:
        target = {"dst_colorspace": Colorspace.ITU709, "dst_color_range": ColorRange.MPEG} if _is_rgb(frame) else {}
        try:
            return self._reformatter.reformat(frame, *self.size, wanted, **target)
        except (av.error.FFmpegError, OSError, ValueError):
            raise PictureError(f"pixel format {frame.format.name!r} cannot be converted, expected one that libswscale reads, "
                               f"such as yuv420p or yuv420p10le") from None

    def _dithered(self, frame: VideoFrame, depth: int, layout: YuvFormat) -> YuvFrame:
        width, height = self.size
        if not self._codes:
            self._codes = [np.empty(shape, dtype=np.uint8) for shape in ((height, width), *[(height // 2, width // 2)] * 2)]
        for index, codes in enumerate(self._codes):
            dithered(_deep_plane(frame, index), depth, full_range=layout.full_range, is_chroma=index > 0, out=codes)
        return YuvFrame(self._codes[0], self._codes[1], self._codes[2], layout)


def _is_rgb(frame: VideoFrame) -> bool:
    """Or grey: without Y'CbCr's matrix and range."""
    return frame.format.is_rgb or frame.format.name.startswith(("gray", "ya", "mono", "pal"))


def _kept_bits(frame: VideoFrame) -> int:
    """Of a code before dithering: 8, 10 or 12."""
    bits = max((component.bits for component in frame.format.components), default=8)
    return 8 if bits <= 8 else 10 if bits <= 10 or _is_rgb(frame) else 12


def _plane(frame: VideoFrame, index: int) -> NDArray[np.uint8]:
    plane = frame.planes[index]
    return np.frombuffer(memoryview(plane), np.uint8).reshape(plane.height, plane.line_size)[:, :plane.width]


def _deep_plane(frame: VideoFrame, index: int) -> NDArray[np.uint16]:
    plane = frame.planes[index]
    return np.frombuffer(memoryview(plane), "<u2").reshape(plane.height, plane.line_size // 2)[:, :plane.width]


class FramePool:
    """Pictures whose planes are those of an FFmpeg frame, which the encoder takes without a copy.

    A frame is used again as soon as nobody holds its picture any more; new ones are made only while all are held.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        self._size = size
        self._free: deque[VideoFrame] = deque()

    def take(self, layout: YuvFormat) -> tuple[YuvFrame, VideoFrame]:
        """A picture of any content, and the frame that it lies in."""
        try:
            video = self._free.pop()
        except IndexError:
            video = VideoFrame(*self._size, "yuv420p")
        picture = YuvFrame(_plane(video, 0), _plane(video, 1), _plane(video, 2), layout)
        weakref.finalize(picture, self._free.append, video).atexit = False
        _tag(video, layout)
        return picture, video


def video_frame(picture: YuvFrame) -> VideoFrame:
    """A new FFmpeg frame with the picture's planes and tags."""
    width, height = picture.size
    frame = VideoFrame(width, height, "yuv420p")
    for index, plane in enumerate((picture.y, picture.u, picture.v)):
        _plane(frame, index)[...] = plane
    _tag(frame, picture.format)
    return frame


def _tag(frame: VideoFrame, layout: YuvFormat) -> None:
    frame.colorspace = 1 if layout.matrix == "bt709" else 6
    frame.color_range = _JPEG if layout.full_range else _MPEG


def encode_jpeg(picture: YuvFrame) -> bytes:
    """JPEG of the picture, converted to JPEG's own BT.601 full range."""
    source = video_frame(picture)
    converted = VideoReformatter().reformat(
        source, format="yuvj420p", src_colorspace=Colorspace.ITU709 if picture.format.matrix == "bt709" else Colorspace.ITU601,
        dst_colorspace=Colorspace.ITU601, src_color_range=ColorRange.JPEG if picture.format.full_range else ColorRange.MPEG,
        dst_color_range=ColorRange.JPEG)
    codec = av.CodecContext.create("mjpeg", "w")
    codec.width, codec.height = picture.size
    codec.pix_fmt = "yuvj420p"
    codec.time_base = Fraction(1, 25)
    codec.options = {"qscale": "3"}
    packets = [*codec.encode(converted), *codec.encode(None)]
    return b"".join(bytes(packet) for packet in packets)

"""Frames at the size of a rendition and in the colours of its codec, for one encoder."""

from __future__ import annotations

from av.filter import Graph
from av.filter.context import FilterContext
from av.video.frame import VideoFrame

from renderer.color import YuvFormat
from server.worker.output_clock import CLOCK_RATE

MIN_SIDE = 16


def scaled_size(size: tuple[int, int], scale: float) -> tuple[int, int]:
    """Even sides of at least 16 pixels, in the proportions of `size`: exactly 2:1 stays exactly 2:1."""
    height = max(2 * round(size[1] * scale / 2), MIN_SIDE)
    return max(2 * round(height * size[0] / size[1] / 2), MIN_SIDE), height


class Scaler:
    """One FFmpeg filter graph, kept for as long as sizes and format stay; a context made for every frame would leak.

    Each result is a frame of its own even where the size stays: then it has the given one's pixels without a copy, but an encoder
    may set its time and type while another reads the same picture.
    """

    def __init__(self, size: tuple[int, int], wanted: tuple[int, int], layout: YuvFormat,
                 wanted_layout: YuvFormat | None = None) -> None:
        """Without `wanted_layout` matrix and range stay."""
        self._graph = Graph()       # its filters do not keep it alive
        self._graph.threads = 1
        matrix, color_range = _names(layout)
        self._input = self._graph.add("buffer", f"video_size={size[0]}x{size[1]}:pix_fmt=yuv420p:time_base=1/{CLOCK_RATE}:"
                                                f"pixel_aspect=1/1:colorspace={matrix}:range={color_range}")
        last = self._input
        if wanted != size:      # the mean of the area: no aliasing, and as cheap as the two-tap filters
            last = self._linked(last, "scale", f"w={wanted[0]}:h={wanted[1]}:flags=area")
        if wanted_layout is not None and wanted_layout != layout:
            last = self._linked(last, "colorspace", _conversion(layout, wanted_layout))
        self._output = self._linked(last, "buffersink", None)
        self._graph.configure()

    def _linked(self, before: FilterContext, name: str, arguments: str | None) -> FilterContext:
        added = self._graph.add(name, arguments)
        before.link_to(added)
        return added

    def frame(self, video: VideoFrame) -> VideoFrame:
        """The frame at the wanted size, tagged with its matrix and range."""
        self._input.push(video)
        scaled = self._output.pull()
        assert isinstance(scaled, VideoFrame)
        return scaled


def _names(layout: YuvFormat) -> tuple[str, str]:
    """FFmpeg's, of matrix and range."""
    return "bt709" if layout.matrix == "bt709" else "smpte170m", "pc" if layout.full_range else "tv"


def _conversion(given: YuvFormat, wanted: YuvFormat) -> str:
    """Of matrix and range alone: the light that the codes stand for stays."""
    (matrix, color_range), (wanted_matrix, wanted_range) = _names(given), _names(wanted)
    return (f"ispace={matrix}:irange={color_range}:iprimaries=bt709:itrc=bt709:"
            f"space={wanted_matrix}:range={wanted_range}:primaries=bt709:trc=bt709:format=yuv420p")

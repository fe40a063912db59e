"""Frames at the size of a rendition, for one encoder."""

from __future__ import annotations

from av.filter import Graph
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

    def __init__(self, size: tuple[int, int], wanted: tuple[int, int], layout: YuvFormat) -> None:
        self._graph = Graph()       # its filters do not keep it alive
        self._graph.threads = 1
        matrix, color_range = "bt709" if layout.matrix == "bt709" else "smpte170m", "pc" if layout.full_range else "tv"
        self._input = self._graph.add("buffer", f"video_size={size[0]}x{size[1]}:pix_fmt=yuv420p:time_base=1/{CLOCK_RATE}:"
                                                f"pixel_aspect=1/1:colorspace={matrix}:range={color_range}")
        self._output = self._graph.add("buffersink")
        if wanted == size:
            self._input.link_to(self._output)
        else:   # the mean of the area: no aliasing, and as cheap as the two-tap filters
            scale = self._graph.add("scale", f"w={wanted[0]}:h={wanted[1]}:flags=area")
            self._input.link_to(scale)
            scale.link_to(self._output)
        self._graph.configure()

    def frame(self, video: VideoFrame) -> VideoFrame:
        """The frame at the wanted size, with the same matrix and range."""
        self._input.push(video)
        scaled = self._output.pull()
        assert isinstance(scaled, VideoFrame)
        return scaled

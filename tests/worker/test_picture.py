from __future__ import annotations

import io

import numpy as np
import pytest
from av.video.frame import VideoFrame
from PIL import Image

from renderer.color import YuvFormat
from server.worker.picture import (
    FramePool,
    PictureError,
    PictureReader,
    encode_jpeg,
    output_size,
    picture_flags,
    video_frame,
    yuv_format,
)
from tests.renderer.frames import noise_frame, yuv_from_linear


@pytest.mark.parametrize("layout", [YuvFormat("bt709", False), YuvFormat("bt601", True)])
def test_planes_and_tags_survive_the_way_through_ffmpegs_frame(layout: YuvFormat) -> None:
    given = noise_frame((66, 34), layout=layout)
    frame = video_frame(given)
    read = PictureReader((66, 34)).read(frame)
    assert all((a == b).all() for a, b in zip((read.y, read.u, read.v), (given.y, given.u, given.v), strict=True))
    assert read.format == layout


@pytest.mark.parametrize(("height", "pix_fmt", "expected"), [
    (1024, "yuv420p", YuvFormat("bt709", False)), (512, "yuv420p", YuvFormat("bt601", False)),
    (1024, "yuvj420p", YuvFormat("bt709", True))])
def test_untagged_video_follows_the_rule(height: int, pix_fmt: str, expected: YuvFormat) -> None:
    assert yuv_format(VideoFrame(2 * height, height, pix_fmt)) == expected


@pytest.mark.parametrize("pix_fmt", ["yuv422p", "yuv420p10le", "nv12", "rgb24", "gray"])
def test_other_formats_are_converted(pix_fmt: str) -> None:
    grey = np.full((64, 128, 3), 128, np.uint8)
    frame = VideoFrame.from_ndarray(grey, format="rgb24").reformat(format=pix_fmt)
    read = PictureReader((128, 64)).read(frame)
    rgb = read.format.rgb_from_yuv() @ np.array([read.y[30, 60] / 255, read.u[15, 30] / 255, read.v[15, 30] / 255, 1])
    assert rgb * 255 == pytest.approx([128, 128, 128], abs=3)


def test_the_output_size_is_even_and_stays() -> None:
    assert output_size(1921, 961) == (1920, 960)
    assert picture_flags(1921, 961, (1920, 960), "yuv420p") == ["odd_size"]
    assert picture_flags(1280, 720, (2048, 1024), "nv12") == ["not_2_to_1", "scaled", "converted"]
    read = PictureReader((128, 64)).read(VideoFrame(322, 162, "yuv420p"))
    assert read.size == (128, 64)


@pytest.mark.parametrize("size", [(8, 4), (100_000, 50_000)])
def test_a_size_out_of_bounds_is_refused(size: tuple[int, int]) -> None:
    with pytest.raises(PictureError, match=f"picture is {size[0]}x{size[1]}, expected 16x16 to"):
        output_size(*size)


@pytest.mark.parametrize("layout", [YuvFormat("bt709", False), YuvFormat("bt601", True)])
def test_a_jpeg_shows_the_colours(layout: YuvFormat) -> None:
    linear = np.zeros((64, 128, 3))
    linear[:, :64] = [0.6, 0.05, 0.05]
    linear[:, 64:] = [0.05, 0.2, 0.7]
    with Image.open(io.BytesIO(encode_jpeg(yuv_from_linear(linear, layout)))) as image:
        pixels = np.asarray(image.convert("RGB")).astype(int)
    assert pixels[30, 30] == pytest.approx([203, 63, 63], abs=4)
    assert pixels[30, 100] == pytest.approx([63, 124, 218], abs=4)


def test_a_pooled_frame_is_used_again_when_its_picture_is_dropped_and_not_before() -> None:
    pool = FramePool((1000, 500))    # lines longer than the picture is wide
    first, first_video = pool.take(YuvFormat("bt601", True))
    second, second_video = pool.take(YuvFormat())
    assert first_video is not second_video
    first.y[:], second.y[:] = 7, 9
    assert (first.y.shape, first.u.shape) == ((500, 1000), (250, 500))
    assert (first_video.to_ndarray()[:500] == 7).all(), "the planes are the frame's own"
    del first
    third, third_video = pool.take(YuvFormat())
    assert third_video is first_video
    assert third.size == (1000, 500)
    assert (second.y == 9).all()
    assert yuv_format(third_video) == YuvFormat()


def test_a_transfer_that_would_be_taken_for_another_is_refused_by_name() -> None:
    frame = VideoFrame(64, 32, "yuv420p10le")
    frame.color_trc = 16
    with pytest.raises(PictureError, match=r"smpte2084.*expected BT\.709"):
        PictureReader((64, 32)).read(frame)

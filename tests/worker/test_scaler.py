from __future__ import annotations

import gc
from pathlib import Path

import numpy as np
import pytest

from renderer.color import YuvFormat
from server.worker.picture import video_frame, yuv_format
from server.worker.scaler import Scaler, scaled_size
from tests.renderer.frames import noise_frame, yuv_from_linear


def resident_mb() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 1e6


@pytest.mark.parametrize(("size", "scale", "expected"), [
    ((2048, 1024), 2 / 3, (1364, 682)), ((2048, 1024), 0.5, (1024, 512)), ((3840, 1920), 2 / 3, (2560, 1280)),
    ((1920, 960), 1.0, (1920, 960)), ((1280, 720), 0.5, (640, 360)), ((32, 16), 0.5, (32, 16))])
def test_sizes_are_even_and_keep_their_proportions(size: tuple[int, int], scale: float, expected: tuple[int, int]) -> None:
    assert scaled_size(size, scale) == expected


@pytest.mark.parametrize("layout", [YuvFormat("bt709", False), YuvFormat("bt709", True), YuvFormat("bt601", False),
                                    YuvFormat("bt601", True)])
def test_a_smaller_picture_has_the_same_colours_and_tags(layout: YuvFormat) -> None:
    linear = np.zeros((128, 256, 3))
    linear[:, :128], linear[:, 128:] = [0.6, 0.05, 0.05], [0.05, 0.2, 0.7]
    full = yuv_from_linear(linear, layout)
    frame = Scaler((256, 128), (172, 86), layout).frame(video_frame(full))
    assert (frame.width, frame.height, frame.format.name) == (172, 86, "yuv420p")
    assert yuv_format(frame) == layout
    planes = frame.to_ndarray()
    for column, given in ((20, 20), (150, 230)):
        assert planes[40, column] == pytest.approx(full.y[60, given], abs=1)
    chroma = planes[86:].reshape(-1)[: 43 * 86].reshape(43, 86)
    assert chroma[20, 10] == pytest.approx(full.u[30, 10], abs=1)


@pytest.mark.parametrize("layout", [YuvFormat("bt709", False), YuvFormat("bt709", True), YuvFormat("bt601", True)])
@pytest.mark.parametrize("size", [(256, 128), (128, 64)])
def test_other_matrix_and_range_mean_the_same_colours(layout: YuvFormat, size: tuple[int, int]) -> None:
    linear, wanted = np.zeros((128, 256, 3)), YuvFormat("bt601", False)
    linear[:, :128], linear[:, 128:] = [0.6, 0.05, 0.05], [0.05, 0.2, 0.7]
    frame = Scaler((256, 128), size, layout, wanted).frame(video_frame(yuv_from_linear(linear, layout)))
    assert yuv_format(frame) == wanted
    expected, planes = yuv_from_linear(linear, wanted), frame.to_ndarray()
    height, width = size[1], size[0]
    luma, chroma = planes[:height], planes[height:].reshape(2, height // 2, width // 2)
    for share in (0.2, 0.8):
        column, given = round(share * width), round(share * 256)
        assert luma[height // 2, column] == pytest.approx(expected.y[64, given], abs=2)
        assert chroma[0, height // 4, column // 2] == pytest.approx(expected.u[32, given // 2], abs=2)
        assert chroma[1, height // 4, column // 2] == pytest.approx(expected.v[32, given // 2], abs=2)


def test_what_is_finer_than_the_smaller_pixels_becomes_their_mean() -> None:
    stripes = noise_frame((256, 128), 0)
    stripes.y[:, 0::2], stripes.y[:, 1::2] = 20, 200
    luma = Scaler((256, 128), (128, 64), YuvFormat()).frame(video_frame(stripes)).to_ndarray()[:64, 2:-2]
    assert np.abs(luma.astype(int) - 110).max() <= 2


def test_at_the_same_size_the_pixels_are_not_copied_but_time_and_type_are_its_own() -> None:
    given = video_frame(noise_frame((256, 128), 1))
    given.pts = 5
    own = Scaler((256, 128), (256, 128), YuvFormat()).frame(given)
    assert own.planes[0].buffer_ptr == given.planes[0].buffer_ptr
    own.pts = 7
    assert given.pts == 5


def test_memory_is_flat_over_500_frames() -> None:
    scaler, frame = Scaler((1024, 512), (682, 342), YuvFormat()), video_frame(noise_frame((1024, 512), 2))
    for _ in range(50):
        scaler.frame(frame)
    gc.collect()
    before = resident_mb()
    for _ in range(500):
        scaler.frame(frame)
    assert resident_mb() - before < 2.0     # one leaked frame in two would be 90 MB

"""More than 8 bits: means are kept, nothing flickers, and formats arrive with their matrix and range."""

from __future__ import annotations

from fractions import Fraction

import av
import numpy as np
import pytest
from av.video.frame import VideoFrame
from hypothesis import given, settings
from hypothesis import strategies as st

from renderer.color import YuvFormat
from server.worker.dither import dithered
from server.worker.picture import PictureError, PictureReader

SIZE = (128, 64)


def as_8_bits(codes: np.ndarray, bits: int = 10, *, full_range: bool = False, is_chroma: bool = False) -> np.ndarray:
    out = np.zeros(codes.shape, dtype=np.uint8)
    dithered(codes.astype(np.uint16), bits, full_range=full_range, is_chroma=is_chroma, out=out)
    return out


def exact(code: float, bits: int, full_range: bool, is_chroma: bool) -> float:
    """Of ITU-R BT.2100, tables 9 and 10: the code of 8 bits for that of more."""
    if not full_range:
        return code / 2 ** (bits - 8)
    return (code - 2 ** (bits - 1)) * 255 / (2**bits - 1) + 128 if is_chroma else code * 255 / (2**bits - 1)


@settings(max_examples=60, deadline=None)
@given(st.data(), st.sampled_from([10, 12]), st.booleans(), st.booleans())
def test_the_mean_is_kept_in_every_8_by_8_pixels(data: st.DataObject, bits: int, full_range: bool, is_chroma: bool) -> None:
    code = data.draw(st.integers(0, 2**bits - 1))
    found = as_8_bits(np.full((40, 72), code), bits, full_range=full_range, is_chroma=is_chroma)
    wanted = min(exact(code, bits, full_range, is_chroma), 255.0)
    means = found.reshape(5, 8, 9, 8).mean(axis=(1, 3))
    tolerance = 0.02 if wanted < 254.5 else 0.5     # there is no brighter code to mix in
    assert means == pytest.approx(wanted, abs=tolerance)
    assert np.ptp(found) <= 1


@pytest.mark.parametrize("full_range", [False, True])
@pytest.mark.parametrize("is_chroma", [False, True])
def test_codes_that_exist_in_8_bits_stay_flat(full_range: bool, is_chroma: bool) -> None:
    codes = [0, 1023] if full_range and not is_chroma else [512] if full_range else [64, 512, 940, 960]
    for code in codes:
        found = as_8_bits(np.full((16, 16), code), full_range=full_range, is_chroma=is_chroma)
        assert (found == round(exact(code, 10, full_range, is_chroma))).all(), code


def test_a_slow_gradient_has_no_bands() -> None:
    """Means over 8 x 8 pixels climb as the codes of 10 bits do; cut off, they would stand still for 64 columns."""
    codes = np.broadcast_to((400 + np.arange(1024) / 16).astype(np.uint16), (64, 1024))
    means = as_8_bits(codes).reshape(8, 8, 128, 8).mean(axis=(0, 1, 3))
    assert np.abs(means - codes[0].reshape(128, 8).mean(axis=1) / 4).max() < 0.02


@pytest.mark.parametrize("size", [(1, 1), (33, 7), (100, 65)])
def test_sizes_that_are_no_multiples_of_the_matrix(size: tuple[int, int]) -> None:
    codes = np.random.default_rng(0).integers(0, 1024, size[::-1])
    assert np.abs(as_8_bits(codes) - np.minimum(codes / 4, 255.0)).max() < 1.0


@pytest.mark.parametrize("garbage", [1024, 40_000, 65_535])
def test_bits_that_should_be_empty_are_white(garbage: int) -> None:
    assert (as_8_bits(np.full((8, 8), garbage)) == 255).all()


def deep_frame(pix_fmt: str, code: int, *, colorspace: int = 1, color_range: int = 1, size: tuple[int, int] = SIZE) -> VideoFrame:
    """One code in all planes of a planar format."""
    frame = VideoFrame(*size, pix_fmt)
    for plane in frame.planes:
        np.frombuffer(memoryview(plane), ">u2" if pix_fmt.endswith("be") else "<u2")[:] = code
    frame.colorspace, frame.color_range = colorspace, color_range
    return frame


@pytest.mark.parametrize("layout", [YuvFormat("bt709", False), YuvFormat("bt601", True), YuvFormat("bt709", True)])
@pytest.mark.parametrize(("pix_fmt", "bits"), [("yuv420p10le", 10), ("yuv420p12le", 12), ("yuv420p10be", 10), ("yuv422p10le", 10),
                                               ("yuv444p10le", 10), ("yuv444p12le", 12)])
def test_deep_formats_keep_their_means_and_tags(pix_fmt: str, bits: int, layout: YuvFormat) -> None:
    code = 2 ** (bits - 10) * 601 + (bits - 10)
    frame = deep_frame(pix_fmt, code, colorspace=1 if layout.matrix == "bt709" else 6, color_range=2 if layout.full_range else 1)
    read = PictureReader(SIZE).read(frame)
    assert read.format == layout
    assert (read.y.shape, read.u.shape, read.v.shape) == ((64, 128), (32, 64), (32, 64))
    for plane, is_chroma in ((read.y, False), (read.u, True), (read.v, True)):
        assert plane.mean() == pytest.approx(exact(code, bits, layout.full_range, is_chroma), abs=0.02)
        assert np.ptp(plane) == 1


def test_a_static_picture_does_not_flicker_and_both_reads_are_the_same() -> None:
    reader, frame = PictureReader(SIZE), deep_frame("yuv420p10le", 0)
    codes = np.random.default_rng(1).integers(64, 940, 64 * 128)
    np.frombuffer(memoryview(frame.planes[0]), "<u2")[:codes.size] = codes
    first = reader.read(frame).copy()
    again = reader.read(deep_copy(frame))
    assert all((a == b).all() for a, b in ((first.y, again.y), (first.u, again.u), (first.v, again.v)))
    other = PictureReader(SIZE).read(frame)
    assert (other.y == first.y).all()


def deep_copy(frame: VideoFrame) -> VideoFrame:
    copy = VideoFrame(frame.width, frame.height, frame.format.name)
    for target, source in zip(copy.planes, frame.planes, strict=True):
        np.frombuffer(memoryview(target), np.uint8)[:] = np.frombuffer(memoryview(source), np.uint8)
    copy.colorspace, copy.color_range = frame.colorspace, frame.color_range
    return copy


def test_another_size_is_scaled_before_it_is_dithered() -> None:
    read = PictureReader(SIZE).read(deep_frame("yuv420p10le", 602, size=(258, 130)))
    assert read.size == SIZE
    assert read.y.mean() == pytest.approx(150.5, abs=0.02)


@pytest.mark.parametrize("pix_fmt", ["gbrp10le", "rgb48le", "gray10le", "x2rgb10le"])
def test_deep_colours_become_limited_range(pix_fmt: str) -> None:
    grey = VideoFrame.from_ndarray(np.full((64, 128, 3), 128, np.uint8), format="rgb24").reformat(format=pix_fmt)
    read = PictureReader(SIZE).read(grey)
    assert read.format == YuvFormat("bt709", False)
    assert read.y.mean() == pytest.approx(16 + 219 * 128 / 255, abs=0.5)
    assert (read.u.mean(), read.v.mean()) == pytest.approx((128, 128), abs=0.3)


def test_a_format_that_cannot_be_converted_is_refused_by_name() -> None:
    with pytest.raises(PictureError, match=r"pixel format 'y210be' cannot be converted, expected .* yuv420p10le"):
        PictureReader(SIZE).read(VideoFrame(*SIZE, "y210be"))


@pytest.mark.parametrize(("encoder", "decoder"), [("libx264", "h264"), ("libx265", "hevc")])
def test_ten_bits_survive_a_decoder_as_means(encoder: str, decoder: str) -> None:
    """A grey of a code and a half, through High 10 or Main 10."""
    writer = av.CodecContext.create(encoder, "w")
    writer.width, writer.height, writer.pix_fmt, writer.time_base = 256, 128, "yuv420p10le", Fraction(1, 25)
    writer.color_range, writer.colorspace = 1, 1
    writer.options = {"crf": "5", "x265-params": "log-level=none"}
    frame = deep_frame("yuv420p10le", 602, size=(256, 128))
    frame.pts = 0
    reader = av.CodecContext.create(decoder, "r")
    packets = [*writer.encode(frame), *writer.encode(None)]
    decoded = [one for packet in (*packets, None) for one in reader.decode(packet)]
    assert [one.format.name for one in decoded] == ["yuv420p10le"]
    read = PictureReader((256, 128)).read(decoded[0])
    assert read.format == YuvFormat("bt709", False)
    assert read.y.mean() == pytest.approx(150.5, abs=0.1)
    assert set(np.unique(read.y)) == {150, 151}

"""The time code in the picture: what is drawn is read, through codecs and scaling, and nothing else is taken for one."""

from __future__ import annotations

from fractions import Fraction

import av
import numpy as np
import pytest
from numpy.typing import NDArray

from server.demo import time_code

NOW = 1_763_750_000.1234
WIDTH, HEIGHT = 1024, 512


def test_what_is_drawn_is_read() -> None:
    luma = noise()
    for seconds in (NOW, NOW + 0.0167, NOW + 3600, 0.0, 429_496.7295):
        time_code.draw(luma, seconds)
        assert time_code.decoded(time_code.read(luma), seconds + 1.0) == pytest.approx(seconds, abs=time_code.UNIT_S)


def test_the_time_is_the_nearest_to_now() -> None:
    luma = noise()
    time_code.draw(luma, NOW)
    turn = 2**32 * time_code.UNIT_S
    blocks = time_code.read(luma)
    assert time_code.decoded(blocks, NOW + turn - 5) == pytest.approx(NOW + turn, abs=1e-3)
    assert time_code.decoded(blocks, NOW - 0.45 * turn) == pytest.approx(NOW, abs=1e-3)


def test_a_picture_without_a_code_has_none() -> None:
    assert time_code.decoded(time_code.read(noise()), NOW) is None
    assert time_code.decoded(time_code.read(np.full((HEIGHT, WIDTH), 16, np.uint8) + 0), NOW) is not None     # all zero: time 0
    assert time_code.decoded([16.0] * 39, NOW) is None


def test_a_wrong_bit_is_noticed() -> None:
    luma = noise()
    time_code.draw(luma, NOW)
    blocks = time_code.read(luma)
    for at in range(len(blocks)):
        wrong = [251 - value if index == at else value for index, value in enumerate(blocks)]
        assert time_code.decoded(wrong, NOW) is None


@pytest.mark.parametrize("scale", [1.0, 2 / 3, 0.5])
def test_it_survives_a_starved_encoder_and_a_smaller_rendition(scale: float) -> None:
    """Camera and service encode one after the other, at a bitrate at which the rest of the picture falls apart."""
    codes = [NOW + index / 30 for index in range(8)]
    pictures = []
    for seconds in codes:
        luma = noise()
        time_code.draw(luma, seconds)
        pictures.append(frame(luma))
    once = encoded_and_decoded(pictures)
    size = (round(WIDTH * scale) // 2 * 2, round(HEIGHT * scale) // 2 * 2)
    twice = encoded_and_decoded([picture.reformat(*size) for picture in once])
    found = [time_code.decoded(time_code.read(luma_of(picture)), NOW) for picture in twice]
    assert found == pytest.approx(codes, abs=time_code.UNIT_S)


def noise() -> NDArray[np.uint8]:
    return np.random.default_rng(4).integers(60, 190, (HEIGHT, WIDTH), np.uint8)


def frame(luma: NDArray[np.uint8]) -> av.VideoFrame:
    chroma = np.full((HEIGHT // 2, WIDTH), 128, np.uint8)
    return av.VideoFrame.from_ndarray(np.concatenate([luma, chroma]), format="yuv420p")


def luma_of(picture: av.VideoFrame) -> NDArray[np.uint8]:
    return picture.to_ndarray(format="yuv420p")[: picture.height]


def encoded_and_decoded(pictures: list[av.VideoFrame]) -> list[av.VideoFrame]:
    encoder = av.CodecContext.create("libx264", "w")
    encoder.width, encoder.height, encoder.pix_fmt = pictures[0].width, pictures[0].height, "yuv420p"
    encoder.time_base = Fraction(1, 30)
    encoder.options = {"preset": "ultrafast", "tune": "zerolatency", "qp": "38"}
    packets = []
    for number, picture in enumerate(pictures):
        picture.pts, picture.time_base = number, Fraction(1, 30)
        packets += encoder.encode(picture)
    decoder = av.CodecContext.create("h264", "r")
    frames = [found for packet in [*packets, *encoder.encode(None)] for found in decoder.decode(av.Packet(bytes(packet)))]
    return [*frames, *decoder.decode(None)]

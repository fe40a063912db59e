from __future__ import annotations

import time

import av
import numpy as np
import pytest

from renderer.color import YuvFormat
from server.worker.encode import Composited, EncodeThread, Plan
from server.worker.h264 import H264Encoder, default_bitrate
from server.worker.picture import video_frame
from server.worker.vp8 import Vp8Encoder
from tests.renderer.frames import noise_frame, yuv_from_linear


def composited(size: tuple[int, int], number: int, layout: YuvFormat | None = None) -> Composited:
    width, height = size
    ramp = np.broadcast_to(np.linspace(0, 1, width)[None, :, None], (height, width, 3))
    picture = yuv_from_linear(np.roll(ramp, number, axis=1), layout)
    return Composited(picture, video_frame(picture), number, number * 3000, time.monotonic(), 0.0)


def test_the_bitrate_follows_the_geometry() -> None:
    assert default_bitrate(2048, 1024) >= 12_000_000
    assert default_bitrate(3840, 1920) >= 30_000_000
    assert default_bitrate(640, 320) < 4_000_000


@pytest.mark.parametrize(("size", "level"), [((640, 320), 30), ((2048, 1024), 40), ((3840, 1920), 51)])
def test_the_stream_is_constrained_baseline_at_a_level_that_fits(size: tuple[int, int], level: int) -> None:
    encoder = H264Encoder(size, 30, default_bitrate(*size), YuvFormat())
    units = encoder.encode(composited(size, 0).video, 0, keyframe=False)
    payload, keyframe = units[0]
    assert keyframe
    start = payload.index(b"\x00\x00\x01\x67") + 3
    profile, constraints, found = payload[start + 1], payload[start + 2], payload[start + 3]
    assert profile == 66
    assert constraints & 0x40
    assert level <= found <= 52


@pytest.mark.parametrize("layout", [YuvFormat("bt709", False), YuvFormat("bt601", True)])
def test_decoding_gives_the_picture_and_its_tags_back(layout: YuvFormat) -> None:
    item = composited((640, 320), 0, layout)
    encoder = H264Encoder((640, 320), 30, 8_000_000, layout)
    decoder = av.CodecContext.create("h264", "r")
    packets = [av.Packet(payload) for payload, _ in encoder.encode(item.video, 0, keyframe=True)]
    frames = [frame for packet in packets for frame in decoder.decode(packet)] + decoder.decode(None)
    assert len(frames) == 1
    assert (int(frames[0].colorspace), int(frames[0].color_range)) == (1 if layout.matrix == "bt709" else 6,
                                                                     2 if layout.full_range else 1)
    luma = frames[0].to_ndarray()[:320].astype(int)
    assert np.abs(luma - item.picture.y).mean() < 2


def test_a_keyframe_comes_on_request_and_requests_are_rate_limited() -> None:
    seen: list[bool] = []
    thread = EncodeThread(lambda payload, keyframe, item: seen.append(keyframe))

    def encode_one(number: int) -> None:
        count = len(seen)
        thread.pictures.put(composited((128, 64), number))
        deadline = time.monotonic() + 10
        while len(seen) == count and time.monotonic() < deadline:
            time.sleep(0.005)

    try:
        encode_one(0)
        encode_one(1)
        thread.request_keyframe()
        thread.request_keyframe()
        encode_one(2)              # too soon after the first
        time.sleep(0.6)
        encode_one(3)
        encode_one(4)
    finally:
        thread.stop()
    assert thread.error is None
    assert seen == [True, False, False, True, False]


def test_a_change_of_bitrate_or_size_needs_no_new_thread() -> None:
    seen: list[int] = []
    bitrates = [1_000_000]
    thread = EncodeThread(lambda payload, keyframe, item: seen.append(item.frame), plan=lambda size: Plan(size, 30, bitrates[-1]))
    try:
        for number, size in enumerate([(128, 64), (256, 128), (128, 64)]):
            bitrates.append(1_000_000 * (number + 1))
            thread.pictures.put(composited(size, number))
            deadline = time.monotonic() + 10
            while number not in seen and time.monotonic() < deadline:
                time.sleep(0.005)
    finally:
        thread.stop()
    assert seen == [0, 1, 2]
    assert thread.pictures.dropped == 0


def test_noise_at_full_size_stays_near_the_bitrate() -> None:
    size = (1024, 512)
    encoder = H264Encoder(size, 30, 4_000_000, YuvFormat())
    sizes = []
    for seed in range(30):
        picture = noise_frame(size, seed)
        units = encoder.encode(video_frame(picture), seed * 3000, keyframe=False)
        sizes.append(sum(len(payload) for payload, _ in units))
    assert sum(sizes[5:]) * 8 / (25 / 30) < 3 * 4_000_000


@pytest.mark.parametrize("layout", [YuvFormat("bt709", False), YuvFormat("bt601", True)])
def test_vp8_has_the_picture_in_the_colours_that_receivers_expect(layout: YuvFormat) -> None:
    """VP8 has no tags: receivers take all of it for BT.601 of limited range."""
    given, payloads = composited((640, 320), 0, layout), []
    thread = EncodeThread(lambda payload, keyframe, item: payloads.append(payload), codec="vp8")
    try:
        thread.pictures.put(given)
        deadline = time.monotonic() + 10
        while not payloads and time.monotonic() < deadline:
            time.sleep(0.005)
    finally:
        thread.stop()
    frames = av.CodecContext.create("vp8", "r").decode(av.Packet(payloads[0]))
    expected = composited((640, 320), 0, YuvFormat("bt601", False)).picture
    luma = frames[0].to_ndarray()[:320].astype(int)
    assert np.abs(luma - expected.y).mean() < 2
    with pytest.raises(ValueError, match="expected YuvFormat"):
        Vp8Encoder((64, 32), 30, 1_000_000, YuvFormat("bt709", False))

"""RTP payloads against aiortc's own unpacking, and what is kept of them for retransmission."""

from __future__ import annotations

import numpy as np
import pytest
from aiortc.codecs import vp8_depayload
from aiortc.codecs.h264 import h264_depayload

from server.delivery.fanout import EncodedFrame
from server.delivery.payloads import payloads
from server.delivery.retransmission import LARGEST_BYTES, SHARE, RetransmissionAllowance
from server.delivery.sent_frames import KEPT_S, SentFrame, SentFrames
from server.delivery.stream_clock import NTP_EPOCH_S, StreamClock


def frame(data: bytes) -> EncodedFrame:
    return EncodedFrame(data, 0, keyframe=True, decoded_at=0.0)


def noise(count: int) -> bytes:
    return np.random.default_rng(1).integers(1, 256, count, np.uint8).tobytes()


@pytest.mark.parametrize("length", [1, 1198, 1199, 1200, 5000, 200_000])
def test_vp8_comes_back_whole(length: int) -> None:
    data = noise(length)
    parts = payloads(frame(data), "vp8")
    assert b"".join(vp8_depayload(part) for part in parts) == data
    assert max(map(len, parts)) <= 1200
    assert [part[0] for part in parts] == [0x10] + [0x00] * (len(parts) - 1)


def test_h264_comes_back_whole() -> None:
    units = [b"\x67" + noise(20), b"\x68" + noise(6), b"\x65" + noise(90_000)]
    parts = payloads(frame(b"".join(b"\0\0\0\1" + unit for unit in units)), "h264")
    assert b"".join(h264_depayload(part) for part in parts) == b"".join(b"\0\0\0\1" + unit for unit in units)
    assert max(map(len, parts)) <= 1300


def test_payloads_are_made_once_for_all_viewers() -> None:
    shared = frame(noise(5000))
    assert payloads(shared, "vp8") is payloads(shared, "vp8")
    assert payloads(shared, "vp8") is shared.moved_to(7).payloads


def test_sent_packets_are_found_across_the_wrap_of_their_numbers_until_they_are_old() -> None:
    sent = SentFrames()
    for number in range(100):
        sent.add(SentFrame(65_500 + 3 * number, [bytes([number, part]) for part in range(3)], number, number / 30))
    for number in (99, 80, 60):
        for part in range(3):
            found = sent.find((65_500 + 3 * number + part) & 0xFFFF)
            assert found is not None
            assert found[0].payloads[found[1]] == bytes([number, part])
    assert sent.find(65_500) is None
    assert sent.find((65_500 + 300) & 0xFFFF) is None
    assert len(sent) == pytest.approx(KEPT_S * 30, abs=2)


def test_retransmission_is_a_share_of_what_is_sent() -> None:
    allowance = RetransmissionAllowance()
    while allowance.take(1000):
        pass
    allowance.media_sent(100_000)
    assert sum(allowance.take(1000) for _ in range(1000)) == pytest.approx(SHARE * 100, abs=1)
    for _ in range(1000):
        allowance.media_sent(100_000)
    assert sum(allowance.take(1000) for _ in range(10_000)) == LARGEST_BYTES / 1000


def test_picture_and_sound_of_one_instant_have_one_ntp_time() -> None:
    clock = StreamClock()
    clock.start(900_000, 90_000, 50.0)
    clock.start(0, 90_000, 0.0)         # only the first counts
    assert clock.ntp(2_700_000, 90_000) == clock.ntp(1_440_000, 48_000)
    assert (clock.ntp(990_000, 90_000) - clock.ntp(900_000, 90_000)) / 2**32 == pytest.approx(1.0, abs=1e-6)
    assert clock.ntp(0, 90_000) / 2**32 > NTP_EPOCH_S

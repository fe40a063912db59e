"""The life of encode threads: made when a track is wanted, gone when nobody wants it any more."""

from __future__ import annotations

import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator

import av
import numpy as np
import pytest

from renderer.color import YuvFormat
from server.renditions import Rendition
from server.worker import encoders as encoders_module
from server.worker.encode import Composited
from server.worker.encoders import Encoders
from server.worker.h264 import default_bitrate
from server.worker.picture import FramePool
from tests.renderer.frames import noise_frame
from tests.worker.test_scaler import resident_mb

SIZE = (256, 128)
LADDER = (Rendition(name="full", scale=1.0), Rendition(name="medium", scale=2 / 3),
          Rendition(name="low", scale=0.5, bitrate_bps=90_000))
Packets = dict[str, list[tuple[bytes, bool, int]]]


class Feed:
    """Encoders, and composites that are put into them one after another."""

    def __init__(self, size: tuple[int, int] = SIZE, bitrate_bps: int | None = None) -> None:
        self.packets: Packets = defaultdict(list)
        self.encoders = Encoders(self._on_packet, LADDER, bitrate_bps)
        self._pool = FramePool(size)
        self._noise = noise_frame(size, 0)
        self._number = 0

    def put(self, *tracks: str) -> None:
        """One composite; returns when each of the tracks has given its packet."""
        counts = {track: len(self.packets[track]) for track in tracks}
        picture, video = self._pool.take(self._noise.format)
        picture.y[...], picture.u[...], picture.v[...] = np.roll(self._noise.y, 2 * self._number, 1), 128, 128
        self._number += 1
        self.encoders.put(Composited(picture, video, self._number, self._number * 3000, time.monotonic(), 0.0))
        eventually(lambda: all(len(self.packets[track]) > count for track, count in counts.items()))
        self.encoders.tend()

    def keyframes(self, track: str) -> list[bool]:
        return [keyframe for _, keyframe, _ in self.packets[track]]

    def _on_packet(self, track: str, payload: bytes, is_keyframe: bool, item: Composited) -> None:
        self.packets[track].append((payload, is_keyframe, item.frame))


def eventually(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.002)


def encode_threads() -> list[str]:
    return sorted(thread.name for thread in threading.enumerate() if thread.name.endswith(" enc"))


@pytest.fixture
def feed() -> Iterator[Feed]:
    fed = Feed()
    yield fed
    fed.encoders.close()
    assert encode_threads() == []


def decoded_sizes(packets: list[tuple[bytes, bool, int]], codec: str) -> set[tuple[int, int]]:
    decoder = av.CodecContext.create(codec, "r")
    frames = [frame for payload, _, _ in packets for frame in decoder.decode(av.Packet(payload))] + decoder.decode(None)
    assert len(frames) == len(packets)
    return {(frame.width, frame.height) for frame in frames}


def test_every_rung_and_codec_decodes_at_its_size(feed: Feed) -> None:
    tracks = [f"{name}/{codec}" for name in ("full", "medium", "low") for codec in ("h264", "vp8")]
    feed.encoders.want(tracks)
    assert feed.encoders.wanted == tracks
    for _ in range(5):
        feed.put(*tracks)
    expected = {"full": (256, 128), "medium": (172, 86), "low": (128, 64)}
    for track in tracks:
        name, codec = track.split("/")
        assert decoded_sizes(feed.packets[track], codec) == {expected[name]}, track
        assert feed.keyframes(track) == [True, False, False, False, False]
    report = feed.encoders.report()
    assert {track: figures["frames_encoded"] for track, figures in report.items()} == dict.fromkeys(tracks, 5)
    assert all(figures["bytes"] == sum(len(payload) for payload, _, _ in feed.packets[track]) for track, figures in report.items())


def test_bitrates_follow_the_full_picture_or_are_the_rungs_own() -> None:
    fed = Feed()
    try:
        size = (2048, 1024)
        assert fed.encoders.renditions(size) == [
            {"name": "full", "width": 2048, "height": 1024, "bitrate_bps": default_bitrate(*size)},
            {"name": "medium", "width": 1364, "height": 682, "bitrate_bps": round(default_bitrate(*size) * 4 / 9)},
            {"name": "low", "width": 1024, "height": 512, "bitrate_bps": 90_000}]
        fed.encoders.set_bitrate(9_000_000)
        assert [rung["bitrate_bps"] for rung in fed.encoders.renditions(size)] == [9_000_000, 4_000_000, 90_000]
    finally:
        fed.encoders.close()


def test_a_rungs_encoder_keeps_to_its_bitrate() -> None:
    fed = Feed(bitrate_bps=3_600_000)
    tracks = ["full/h264", "medium/h264"]
    try:
        fed.encoders.want(tracks)
        for _ in range(50):
            fed.put(*tracks)
        fed.encoders.set_bitrate(400_000, "medium/h264")
        for _ in range(60):
            fed.put(*tracks)
        bits = {track: [8 * len(payload) for payload, _, _ in fed.packets[track]] for track in tracks}
        full, medium, less = sum(bits["full/h264"][20:50]), sum(bits["medium/h264"][20:50]), sum(bits["medium/h264"][80:])
        assert full <= 1.3 * 3_600_000
        assert medium <= 1.3 * 1_600_000
        assert less < 0.5 * medium
        assert fed.keyframes("medium/h264")[50], "another bitrate is another encoder"
        assert not fed.keyframes("full/h264")[50]
    finally:
        fed.encoders.close()


def test_a_keyframe_on_request_for_one_track_leaves_the_others_alone(feed: Feed) -> None:
    tracks = ["full/h264", "full/vp8", "low/h264", "low/vp8"]
    feed.encoders.want(tracks)
    feed.put(*tracks)
    time.sleep(0.55)
    for requested in tracks:
        feed.encoders.request_keyframe(requested)
        feed.put(*tracks)
        assert {track: feed.keyframes(track)[-1] for track in tracks} == {track: track == requested for track in tracks}


@pytest.mark.parametrize("codec", ["h264", "vp8"])
def test_a_request_within_the_pause_is_served_when_it_ends(feed: Feed, codec: str) -> None:
    track = f"full/{codec}"
    feed.encoders.want([track])
    feed.put(track)
    for _ in range(3):
        feed.encoders.request_keyframe(track)
    feed.put(track)
    time.sleep(0.55)
    feed.put(track)
    time.sleep(0.55)
    feed.put(track)
    assert feed.keyframes(track) == [True, False, True, False]


def test_who_comes_back_within_the_grace_finds_the_encoder_and_gets_a_keyframe(feed: Feed, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(encoders_module, "GRACE_S", 1.0)
    feed.encoders.want(["full/h264", "low/h264"])
    feed.put("full/h264", "low/h264")
    feed.encoders.want(["full/h264"])
    feed.put("full/h264")
    assert len(feed.packets["low/h264"]) == 1, "nobody wants it"
    assert encode_threads() == ["full/h264 enc", "low/h264 enc"]
    time.sleep(0.55)
    feed.encoders.want(["full/h264", "low/h264"])
    feed.put("full/h264", "low/h264")
    assert feed.keyframes("low/h264") == [True, True]
    assert feed.keyframes("full/h264") == [True, False, False]
    feed.encoders.want(["full/h264"])
    time.sleep(1.05)
    feed.put("full/h264")
    eventually(lambda: encode_threads() == ["full/h264 enc"])
    assert set(feed.encoders.report()) == {"full/h264"}


def test_counted_are_the_frames_of_the_best_track_that_is_wanted(feed: Feed) -> None:
    feed.encoders.want(["low/vp8"])
    feed.put("low/vp8")
    feed.encoders.want(["full/vp8", "low/vp8"])
    feed.put("low/vp8", "full/vp8")
    feed.put("low/vp8", "full/vp8")
    feed.encoders.want(["medium/h264"])
    feed.put("medium/h264")
    eventually(lambda: feed.encoders.frames_encoded == 4)
    assert (feed.encoders.frames_dropped, feed.encoders.frames_lost) == (0, 0)


def test_a_frame_goes_back_to_the_pool_when_the_last_encoder_has_let_go() -> None:
    hold, held = threading.Event(), threading.Event()

    def on_packet(track: str, payload: bytes, is_keyframe: bool, item: Composited) -> None:
        if track == "low/h264":
            held.set()
            hold.wait(20)
        else:
            done.append(track)

    done: list[str] = []
    slow, pool = Encoders(on_packet, LADDER), FramePool(SIZE)
    try:
        slow.want(["full/h264", "full/vp8", "low/h264"])
        picture, video = pool.take(noise_frame(SIZE, 0).format)
        slow.put(Composited(picture, video, 1, 3000, time.monotonic(), 0.0))
        first = video.planes[0].buffer_ptr
        del picture, video
        assert held.wait(20)
        eventually(lambda: len(done) == 2)
        taken = [pool.take(YuvFormat()) for _ in range(3)]
        assert first not in [video.planes[0].buffer_ptr for _, video in taken]
        hold.set()

        def is_back() -> bool:
            taken.append(pool.take(YuvFormat()))
            return taken[-1][1].planes[0].buffer_ptr == first

        eventually(is_back)
    finally:
        hold.set()
        slow.close()


def test_unknown_tracks_are_refused_by_name_and_harm_nothing(feed: Feed, caplog: pytest.LogCaptureFixture) -> None:
    feed.encoders.want(["full/h264", "huge/h264", "full/av1"])
    feed.encoders.request_keyframe("huge/h264")
    assert feed.encoders.wanted == ["full/h264"]
    assert "track 'full/av1' is not known, expected one of full/h264" in caplog.text
    feed.put("full/h264")


def test_50_cycles_of_demand_leave_threads_and_memory_where_they_were(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(encoders_module, "GRACE_S", 0.0)
    size, tracks = (1024, 512), ["full/h264", "medium/h264", "low/vp8"]
    fed = Feed(size)
    try:
        for cycle in range(60):
            if cycle == 10:
                before = resident_mb()
            fed.encoders.want(tracks)
            fed.put(*tracks)
            fed.encoders.want([])
            fed.encoders.tend()
            eventually(lambda: not encode_threads())
            fed.packets.clear()
        assert resident_mb() - before < 20.0        # an encoder at this size has 30 MB and more
    finally:
        fed.encoders.close()

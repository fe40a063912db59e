"""A viewer's feed: how it changes its rendition without a picture that cannot be decoded."""

from __future__ import annotations

import asyncio

import pytest

from server.delivery.fanout import EncodedFrame
from server.delivery.reception import Report
from server.delivery.subscription import Choice, PictureFeed, SoundFeed
from server.delivery.tracks import Tracks
from server.renditions import AUDIO

NAMES = ["full", "medium", "low"]


class Stream:
    """Tracks whose worker is this test."""

    def __init__(self) -> None:
        self.keyframes: list[str] = []
        self.demands: list[list[str]] = []
        self.tracks = Tracks(request_keyframe=self.keyframes.append, demand_changed=lambda: self.demands.append(self.tracks.wanted))
        self.tracks.nominal_bps = {"full/h264": 10e6, "medium/h264": 4.4e6, "low/h264": 2.5e6}

    def feed(self, best: int = 0, lowest: int = 2) -> PictureFeed:
        return PictureFeed(self.tracks, NAMES, "h264", Choice(best, lowest), lambda seconds: None)

    def publish(self, name: str, timestamp: int, keyframe: bool = False) -> EncodedFrame:
        frame = EncodedFrame(name.encode(), timestamp, keyframe=keyframe, decoded_at=0.0)
        self.tracks.publish(name, frame)
        return frame


async def take(feed: PictureFeed | SoundFeed) -> tuple[str, int]:
    frame = await asyncio.wait_for(feed.next_frame(), 5)
    return frame.data.decode(), frame.timestamp


async def joined(stream: Stream, feed: PictureFeed) -> None:
    """The feed has its first keyframe, at 0."""
    waiting = asyncio.create_task(take(feed))
    await asyncio.sleep(0.01)
    stream.publish("full/h264", 0, keyframe=True)
    assert await waiting == ("full/h264", 0)


def narrow(feed: PictureFeed, at: float) -> None:
    feed.reception.heard(Report(at, 0.8, False))


async def test_the_old_rendition_goes_on_until_the_new_one_has_a_keyframe() -> None:
    stream = Stream()
    feed = stream.feed()
    await joined(stream, feed)
    narrow(feed, 10.0)
    assert stream.tracks.wanted == ["full/h264", "low/h264"]
    assert stream.keyframes[-1] == "low/h264"
    stream.publish("full/h264", 3000)
    stream.publish("low/h264", 3000)
    assert await take(feed) == ("full/h264", 3000)
    stream.publish("full/h264", 6000)
    stream.publish("low/h264", 9000, keyframe=True)
    stream.publish("full/h264", 9000)
    stream.publish("low/h264", 12000)
    assert [await take(feed) for _ in range(3)] == [("full/h264", 6000), ("low/h264", 9000), ("low/h264", 12000)]
    assert feed.rendition == "low"
    assert stream.tracks.wanted == ["low/h264"]


async def test_the_keyframe_of_a_picture_that_was_sent_already_comes_a_tick_later() -> None:
    stream = Stream()
    feed = stream.feed()
    await joined(stream, feed)
    narrow(feed, 10.0)
    stream.publish("full/h264", 3000)
    assert await take(feed) == ("full/h264", 3000)
    key = stream.publish("low/h264", 3000, keyframe=True)
    stream.publish("low/h264", 6000)
    assert [await take(feed), await take(feed)] == [("low/h264", 3001), ("low/h264", 6000)]
    assert key.timestamp == 3000        # it is shared with other viewers


async def test_pictures_of_an_encoder_that_is_behind_are_all_sent() -> None:
    """Each is needed by the next one, and no gap in RTP's numbers would tell the viewer that one is missing."""
    stream = Stream()
    feed = stream.feed()
    await joined(stream, feed)
    narrow(feed, 10.0)
    for timestamp in (3000, 6000):
        stream.publish("full/h264", timestamp)
        await take(feed)
    stream.publish("low/h264", 3000, keyframe=True)
    for timestamp in (6000, 9000):
        stream.publish("low/h264", timestamp)
    assert [await take(feed) for _ in range(3)] == [("low/h264", 6001), ("low/h264", 6002), ("low/h264", 9000)]


async def test_a_report_after_the_end_joins_nothing() -> None:
    stream = Stream()
    feed = stream.feed()
    await joined(stream, feed)
    feed.close()
    narrow(feed, 10.0)
    assert stream.tracks.wanted == []


async def test_a_second_change_of_mind_leaves_the_first_one_s_track() -> None:
    stream = Stream()
    feed = stream.feed()
    await joined(stream, feed)
    feed.reception.heard(Report(10.0, 0.4, False))
    assert stream.tracks.wanted == ["full/h264", "low/h264"] or stream.tracks.wanted == ["full/h264", "medium/h264"]
    narrow(feed, 11.0)
    narrow(feed, 12.0)
    assert stream.tracks.wanted == ["full/h264", "low/h264"]
    feed.close()
    assert stream.tracks.wanted == []
    assert stream.tracks.viewers == 0


async def test_a_viewer_back_from_an_outage_gets_a_keyframe_at_once() -> None:
    stream = Stream()
    feed = stream.feed()
    await joined(stream, feed)
    stream.keyframes.clear()
    feed.reception.heard(Report(20.0, 0.9, True))
    assert stream.keyframes == ["full/h264"]
    assert feed.rendition == "full"


async def test_a_fixed_rendition_is_kept() -> None:
    stream = Stream()
    feed = stream.feed(best=1, lowest=1)
    waiting = asyncio.create_task(take(feed))
    await asyncio.sleep(0.01)
    stream.publish("medium/h264", 0, keyframe=True)
    assert await waiting == ("medium/h264", 0)
    for second in range(10):
        narrow(feed, second)
    assert stream.tracks.wanted == ["medium/h264"]


async def test_closing_before_anything_was_sent_leaves_nothing() -> None:
    stream = Stream()
    feed = stream.feed()
    feed.close()
    feed.close()
    assert (stream.tracks.viewers, stream.tracks.wanted) == (0, [])


async def test_sound_needs_no_keyframe_and_counts_no_viewer() -> None:
    stream = Stream()
    feed = SoundFeed(stream.tracks)
    waiting = asyncio.create_task(take(feed))
    await asyncio.sleep(0.01)
    assert stream.tracks.wanted == [AUDIO]
    stream.publish(AUDIO, 960)
    assert await waiting == (AUDIO, 960)
    assert (stream.tracks.viewers, stream.keyframes) == (0, [])
    feed.close()
    assert stream.tracks.wanted == []


@pytest.mark.parametrize("measured", [True, False])
def test_rates_of_renditions_that_nobody_watches_are_scaled_by_what_is_measured(measured: bool) -> None:
    stream = Stream()
    rate = stream.tracks.fanout("full/h264").rate
    if measured:
        import time
        now = time.monotonic()
        for number in range(11):
            rate.add(62_500 if number else 0, now - 1 + number / 10)
    rates = stream.tracks.rates(["full/h264", "medium/h264", "low/h264"])
    assert rates == pytest.approx([5e6, 2.2e6, 1.25e6] if measured else [10e6, 4.4e6, 2.5e6], rel=0.05)


async def test_pictures_are_shown_at_once_until_there_is_sound() -> None:
    stream = Stream()
    feed = stream.feed()
    assert feed.at_once
    feed.sound = SoundFeed(stream.tracks)
    assert feed.at_once
    waiting = asyncio.create_task(take(feed.sound))
    await asyncio.sleep(0.01)
    stream.publish(AUDIO, 0)
    await waiting
    assert not feed.at_once

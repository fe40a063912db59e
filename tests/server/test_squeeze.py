"""The bitrate of the smallest rendition, for networks that do not carry it."""

from __future__ import annotations

import asyncio

import pytest

from server.delivery.fanout import EncodedFrame
from server.delivery.reception import Report
from server.delivery.squeeze import FLOOR_SHARE, PAUSE_S, QUIET_S, Squeeze
from server.delivery.subscription import Choice, PictureFeed
from server.delivery.tracks import Tracks

NOMINAL = 3e6


def squeeze() -> tuple[Squeeze, list[int | None]]:
    told: list[int | None] = []
    return Squeeze(told.append), told


def test_it_follows_what_comes_through_and_no_further_than_the_floor() -> None:
    one, told = squeeze()
    one.trouble(0.0, 2e6, NOMINAL)
    one.trouble(0.5 * PAUSE_S, 1e6, NOMINAL)        # still about the old bitrate
    one.trouble(PAUSE_S, 1e6, NOMINAL)
    one.trouble(2 * PAUSE_S, 1.0, NOMINAL)
    one.trouble(3 * PAUSE_S, 1.0, NOMINAL)
    assert told == [1_600_000, 800_000, round(FLOOR_SHARE * NOMINAL)]


def test_it_comes_back_in_steps_when_nobody_is_in_trouble() -> None:
    one, told = squeeze()
    one.trouble(0.0, 2e6, NOMINAL)
    for tenth in range(1000):
        one.quiet(tenth / 10, NOMINAL)
    assert told[1:] == [2_000_000, 2_500_000, None]
    assert one.bps is None


def test_one_viewer_in_trouble_outweighs_all_who_are_well() -> None:
    one, told = squeeze()
    for second in range(100):
        one.quiet(second, NOMINAL)
        one.trouble(second, 2e6, NOMINAL)
    assert told == [1_600_000]
    assert QUIET_S > PAUSE_S


class Encoder:
    """What the bitrate of `low/h264` is set to, of a stream whose worker is this test."""

    def __init__(self) -> None:
        self.told: list[tuple[str, int | None]] = []
        self.tracks = Tracks(request_keyframe=lambda track: None, demand_changed=lambda: None,
                             set_bitrate=lambda track, bps: self.told.append((track, bps)))
        self.tracks.nominal_bps = {"full/h264": 12e6, "low/h264": NOMINAL}

    async def starving(self, names: list[str], choice: Choice) -> PictureFeed:
        """A viewer that receives the track of its choice and then half of it."""
        feed = PictureFeed(self.tracks, names, "h264", choice, lambda seconds: None)
        waiting = asyncio.create_task(feed.next_frame())
        await asyncio.sleep(0.01)
        self.tracks.publish(f"{names[choice.best]}/h264", EncodedFrame(b"x", 0, keyframe=True, decoded_at=0.0))
        await waiting
        feed.reception.heard(Report(100.0, 0.5, False))
        return feed


@pytest.mark.parametrize(("names", "choice", "squeezed"), [
    (["full", "low"], Choice(1, 1), True),
    (["full", "low"], Choice(0, 0), False),
    (["full"], Choice(0, 0), False),        # one viewer must not spoil the only picture
])
async def test_only_the_smallest_rendition_of_several_is_squeezed(names: list[str], choice: Choice, squeezed: bool) -> None:
    encoder = Encoder()
    await encoder.starving(names, choice)
    assert [track for track, _ in encoder.told] == ["low/h264"] * squeezed


async def test_when_its_last_viewer_has_left_a_recording_gets_the_whole_bitrate_again() -> None:
    encoder = Encoder()
    output = encoder.tracks.fanout("low/h264").join()
    first = await encoder.starving(["full", "low"], Choice(1, 1))
    second = await encoder.starving(["full", "low"], Choice(1, 1))
    first.close()
    assert encoder.tracks.squeezed() != {}
    second.close()
    assert encoder.tracks.squeezed() == {}
    assert encoder.told[-1] == ("low/h264", None)
    encoder.tracks.fanout("low/h264").leave(output)

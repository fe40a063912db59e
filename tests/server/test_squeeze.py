"""The bitrate of the smallest rendition, for networks that do not carry it."""

from __future__ import annotations

import pytest

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


@pytest.mark.parametrize(("choice", "expected"), [(Choice(0, 1), ["low/h264"]), (Choice(0, 0), [])])
def test_only_the_smallest_rendition_is_squeezed(choice: Choice, expected: list[str]) -> None:
    told: list[str] = []
    tracks = Tracks(request_keyframe=lambda track: None, demand_changed=lambda: None,
                    set_bitrate=lambda track, bps: told.append(track))
    tracks.nominal_bps = {"full/h264": 12e6, "low/h264": NOMINAL}
    feed = PictureFeed(tracks, ["full", "low"], "h264", choice, lambda seconds: None)
    feed._rendition = feed.adaptation.rendition = choice.lowest
    feed.reception.heard(Report(100.0, 0.5, False))
    assert told == expected

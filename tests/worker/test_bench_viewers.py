"""The benchmark of viewers: counting by headers, and a whole small run."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from server.bench import viewers, viewers_rtp
from server.bench.service_options import one_size
from server.bench.viewers_rtp import RtpCount
from server.bench.viewers_tables import churn_lines, row_line, verdict_lines

FPS = 30.0
STEP = 3000


class Sent:
    """Headers of frames of three packets, in order."""

    def __init__(self, frames: int, first: int = 65530, keyframes: tuple[int, ...] = (0,)) -> None:
        self.headers = [((first + 3 * frame + part) & 0xFFFF, frame * STEP, part == 2, part == 0 and frame in keyframes)
                        for frame in range(frames) for part in range(3)]

    def to(self, count: RtpCount, numbers: Iterator[int] | range | list[int] | None = None) -> None:
        for number in range(len(self.headers)) if numbers is None else numbers:
            sequence, timestamp, marker, keyframe = self.headers[number]
            count.packet(sequence, timestamp, marker=marker, keyframe=keyframe)


def test_whole_frames_are_counted_across_the_wrap_of_sequence_numbers() -> None:
    count = RtpCount(time.time(), FPS)
    Sent(10).to(count)
    assert (count.frames, count.keyframes, count.incomplete, count.lost, count.packets) == (10, 1, 0, 0, 30)
    assert count.expected == 30
    assert sum(count.delays_ms.values()) == 10


def test_nothing_counts_before_the_first_keyframe() -> None:
    count = RtpCount(time.time(), FPS)
    Sent(6, keyframes=(4,)).to(count)
    assert (count.frames, count.undecodable) == (2, 4)
    assert count.first_keyframe_at is not None


def test_a_packet_that_comes_again_completes_its_frame() -> None:
    count, sent = RtpCount(time.time(), FPS), Sent(4)
    order = [number for number in range(12) if number != 4]
    sent.to(count, order)
    assert count.missing() == [(65530 + 4) & 0xFFFF]
    assert count.frames == 1
    sent.to(count, [4])
    assert (count.frames, count.incomplete, count.lost, count.missing()) == (4, 0, 0, [])


def test_what_is_given_up_breaks_what_follows_until_a_keyframe(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(viewers_rtp, "GIVE_UP_S", 0.0)
    count, sent = RtpCount(time.time(), FPS), Sent(6, keyframes=(0, 4))
    sent.to(count, [number for number in range(18) if number not in (4, 5)])        # also the marker
    assert count.give_up(time.monotonic() + 0.1)
    assert (count.lost, count.frames) == (2, 3)         # 0, 4 and 5
    assert count.incomplete + count.undecodable >= 2    # 1, 2 and perhaps 3
    sent.to(count, [5])
    assert count.late == 1


def test_swapped_packets_are_nothing_lost() -> None:
    count, sent = RtpCount(time.time(), FPS), Sent(3)
    sent.to(count, [0, 2, 1, 4, 3, 5, 6, 7, 8])
    assert (count.frames, count.incomplete, count.late) == (3, 0, 0)


def test_a_long_pause_is_a_gap() -> None:
    count, sent = RtpCount(time.time(), FPS), Sent(3)
    sent.to(count, range(6))
    assert count.gaps == 0
    time.sleep(0.12)
    sent.to(count, range(6, 9))
    assert count.gaps == 1
    assert count.longest_gap_s >= 0.12


def test_a_whole_small_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "viewers.json"
    assert viewers.main(["--counts", "1,2", "--seconds", "2", "--warm-up", "1", "--guests", "3", "--size",
                         "256x128", "--fps", "10", "--json", str(file)]) == 0
    report: dict[str, Any] = json.loads(file.read_text())
    assert [row["viewers"] for row in report["rows"]] == [1, 2]
    for row in report["rows"]:
        assert row["frames"] > 0
        assert row["fps_min"] <= row["fps_mean"]
        assert 0 < row["joins_ms"]["p50"] <= row["joins_ms"]["max"]
        assert row["latency_ms"]["p50"] <= row["latency_ms"]["p95"]
        assert row["sender_reports_ms"] is None or abs(row["sender_reports_ms"]["p50"]) < 60_000
        assert set(row["cores"]) == {"worker", "server", "publisher", "viewer"}
    assert report["churn"]["guests"] == 3
    assert report["churn"]["frames"] > 0
    assert report["slope"]["cores_a_viewer"] == pytest.approx(
        report["rows"][1]["cores"]["server"] - report["rows"][0]["cores"]["server"], abs=1e-4)
    printed = capsys.readouterr().out
    assert all(line in printed for line in (*map(row_line, report["rows"]), *churn_lines(report), *verdict_lines(report)))


def test_delays_between_two_lines() -> None:
    found = viewers.delay_percentiles({"3": 5}, {"3": 5, "10": 90, "40": 10})
    assert found == {"p50": 10.5, "p95": 40.5, "max": 40.5}
    assert viewers.delay_percentiles({"3": 5}, {"3": 5}) is None


def test_slope_is_that_of_a_line() -> None:
    assert viewers.slope([1, 5, 10], [0.12, 0.2, 0.3]) == {"cores_without": 0.1, "cores_a_viewer": 0.02}


def test_bad_arguments_are_status_2_and_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, expected in ((["--counts", "0"], "'0' given"), (["--size", "10x5"], "'10x5' given"),
                                (["--size", "512x256,256x128"], "expected one size"), (["--json", "/no/x"], "'/no/x' given")):
        with pytest.raises(SystemExit) as ended:
            viewers.main(arguments)
        error = capsys.readouterr().err
        assert (ended.value.code, error.count("\n")) == (2, 1)
        assert expected in error
    assert one_size("512x256") == "512x256"

"""Receiver reports put together: many come with NACKs, on a few packets each."""

from __future__ import annotations

import numpy as np
import pytest

from server.delivery.reception import Reception, Report


def reports(seconds: float, loss: float, packets_a_second: int, each_s: float) -> list[Report]:
    """What is heard when a receiver loses packets at random and reports so often."""
    reception, heard = Reception(), []
    reception.heard = heard.append
    lost = np.cumsum(np.random.default_rng(3).random(int(seconds * packets_a_second) + 1) < loss)
    for number in range(int(seconds / each_s)):
        sent = int(number * each_s * packets_a_second)
        reception.report(number * each_s, int(lost[sent]), 65_000 + sent, None)
    return heard


@pytest.mark.parametrize("each_s", [1.0, 0.5, 0.05])
def test_loss_is_told_once_a_second_however_often_it_is_reported(each_s: float) -> None:
    heard = reports(60, 0.02, 1000, each_s)
    assert 40 <= len(heard) <= 75
    assert np.mean([report.fraction_lost for report in heard]) == pytest.approx(0.02, rel=0.2)
    assert max(report.fraction_lost for report in heard) < 0.06


def test_one_packet_lost_of_very_few_is_not_much() -> None:
    assert max(report.fraction_lost for report in reports(60, 0.05, 4, 0.5)) <= 0.1


def test_all_lost_is_all_lost_and_a_late_packet_is_no_gain() -> None:
    reception, heard = Reception(), []
    reception.heard = heard.append
    reception.report(0.0, 0, 1000, None)
    reception.report(1.0, 500, 1500, None)
    reception.report(2.0, 450, 1900, None)
    assert [report.fraction_lost for report in heard] == [1.0, 0.0]
    assert reception.packets_lost == 450


def test_a_queue_is_told_by_the_round_trip() -> None:
    reception, heard = Reception(), []
    reception.heard = heard.append
    for second, rtt_s in enumerate((0.05, 0.04, 0.3, 0.04)):
        reception.report(float(second), 0, 1000 * second, rtt_s)
    assert [round(report.queued_s, 3) for report in heard] == [0.0, 0.26, 0.0]


def test_silence_is_told() -> None:
    reception, heard = Reception(), []
    reception.heard = heard.append
    for at in (0.0, 1.0, 7.0, 7.1, 8.0):
        reception.report(at, 0, int(1000 * at), 0.04)
    assert [(report.at, report.after_silence) for report in heard] == [(1.0, False), (7.0, True), (8.0, False)]
    assert reception.rtt_s == pytest.approx(0.04)

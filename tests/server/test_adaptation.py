"""Which rendition a viewer gets, by what its receiver reports."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field

import pytest

from server.delivery.adaptation import FIRST_WAIT_S, LONGEST_WAIT_S, Adaptation, Estimate
from server.delivery.reception import Report

RATES = (10e6, 4.4e6, 2.5e6)


@dataclass
class Network:
    """A link of a certain rate: what is too much for it is lost, and REMB says so as browsers do."""

    carries_bps: float
    remb: bool = True
    now: float = 100.0
    adaptation: Adaptation = field(default_factory=lambda: Adaptation(0, 2, 100.0))

    def second(self, loss: float = 0.0, silent: bool = False) -> int:
        self.now += 1.0
        sent = RATES[self.adaptation.rendition]
        lost = max(loss, 1 - self.carries_bps / sent)
        estimate = Estimate(int(min(self.carries_bps, 1.5 * sent)), self.now - 0.2) if self.remb else None
        return self.adaptation.take(Report(self.now, lost, silent), estimate, RATES)

    def seconds(self, count: int, loss: float = 0.0) -> list[int]:
        return [self.second(loss) for _ in range(count)]


@pytest.mark.parametrize("remb", [True, False])
def test_a_narrow_network_gets_what_it_carries_within_three_seconds(remb: bool) -> None:
    assert Network(3e6, remb).seconds(3)[-1] == 2
    assert Network(6e6, remb).seconds(3)[-1] == 1
    assert Network(30e6, remb).seconds(60) == [0] * 60


def test_a_network_that_is_only_slightly_too_narrow_is_noticed_by_its_estimate() -> None:
    assert Network(8e6).seconds(8)[-1] == 1


def test_random_loss_is_no_reason_to_step_down() -> None:
    assert Network(30e6).seconds(100, loss=0.02) == [0] * 100


def test_one_bad_second_is_not_enough_two_are() -> None:
    network = Network(30e6)
    assert [network.second(0.2), network.second(0.0), network.second(0.2), network.second(0.2)] == [0, 0, 0, 1]


def test_an_outage_is_not_a_narrow_network() -> None:
    network = Network(30e6)
    network.seconds(5)
    network.now += 5
    assert network.second(0.97, silent=True) == 0
    assert network.seconds(20) == [0] * 20


def test_a_network_that_recovers_is_stepped_up_one_by_one() -> None:
    network = Network(3e6)
    network.seconds(3)
    network.carries_bps = 30e6
    seen = network.seconds(40)
    assert seen[-1] == 0
    assert seen.count(2) >= FIRST_WAIT_S - 3     # it has been clean before
    assert seen.count(1) >= FIRST_WAIT_S - 1
    assert network.adaptation.steps_up == 2


def test_steps_up_that_fail_become_ever_rarer() -> None:
    network = Network(3e6)
    seen = network.seconds(1200)
    tries = [second for second in range(1, 1200) if seen[second] < seen[second - 1]]
    pauses = [later - earlier for earlier, later in itertools.pairwise(tries)]
    assert len(tries) <= 9
    assert pauses == sorted(pauses)
    assert max(pauses) >= LONGEST_WAIT_S
    assert sum(rendition != 2 for rendition in seen[10:]) <= 3 * len(tries)


def test_a_low_estimate_counts_only_with_a_sign_of_a_queue() -> None:
    for queued_s, expected in ((0.0, 0), (0.2, 2)):
        adaptation = Adaptation(0, 2, 0.0)
        for second in range(1, 10):
            rendition = adaptation.take(Report(float(second), 0.0, False, queued_s), Estimate(2_800_000, second - 0.1), RATES)
        assert rendition == expected


def test_limits_are_kept() -> None:
    fixed = Network(1e6, adaptation=Adaptation(0, 0, 100.0))
    assert fixed.seconds(20) == [0] * 20
    capped = Network(1e9, adaptation=Adaptation(1, 2, 100.0))
    assert capped.seconds(60) == [1] * 60


def test_an_old_estimate_says_nothing() -> None:
    adaptation = Adaptation(0, 2, 0.0)
    for second in range(1, 30):
        assert adaptation.take(Report(float(second), 0.0, False), Estimate(100_000, 1.0), RATES) == 0


def test_a_quiet_picture_is_not_too_much_for_a_narrow_network() -> None:
    adaptation = Adaptation(0, 2, 0.0)
    for second in range(1, 30):
        assert adaptation.take(Report(float(second), 0.0, False), Estimate(1_500_000, second - 0.1), (1e6, 4e5, 2e5)) == 0


def test_an_estimate_that_dips_and_comes_back_is_no_reason_to_step_down() -> None:
    adaptation = Adaptation(0, 2, 0.0)
    for second in range(1, 60):
        estimate = Estimate(int(RATES[0] * (0.85 if second % 10 < 3 else 1.2)), second - 0.1)
        assert adaptation.take(Report(float(second), 0.02, False), estimate, RATES) == 0

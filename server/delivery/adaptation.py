"""Which rendition a viewer's network carries: down within seconds of trouble, up again only when that has a chance.

The evidence is RTCP's: the share of packets lost (receiver reports, each second) and the viewer's own estimate of its bandwidth
(REMB), where it gives one. REMB never says more than one and a half times of what is being sent, so going up is a trial; each one
that fails doubles the wait before the next.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from server.delivery.reception import Report

LOST_BADLY = 0.35           # one report is enough
LOST = 0.08                 # two reports in a row: bad luck is shorter
CLEAN = 0.03
# An estimate below such a part of the rendition's rate for so many seconds. A browser that takes the jitter of retransmissions for
# a queue goes down by 15 % and comes back. And it counts only where there is a sign of a queue: a receiver whose machine is busy
# sees packets come unevenly too.
REMB_SHORT = ((0.75, 1.2), (0.9, 5.0))
QUEUED_S = 0.03
USABLE = 0.9                # of what the network is thought to carry
FIRST_WAIT_S, LONGEST_WAIT_S = 8.0, 240.0
TRIAL_S = 8.0               # a step up that has to be taken back within this time has failed
FRESH_S = 2.5               # an older REMB says nothing,
SETTLING_S = 3.0            # nor does one that is still about what was sent before


@dataclass(frozen=True, slots=True)
class Estimate:
    """REMB, in bits per second, and when it came."""

    bps: int
    at: float


class Adaptation:
    """Of one viewer. Renditions are numbered from the best one, 0; times are monotonic seconds."""

    def __init__(self, best: int, lowest: int, now: float) -> None:
        """`best` and `lowest`: the renditions it may choose among."""
        self.rendition = best
        self.steps_down = self.steps_up = 0
        self.starved_bps: float | None = None       # what came through of the lowest rendition, if the last report says too little
        self._best, self._lowest = best, lowest
        self._wait_s = FIRST_WAIT_S
        self._clean_since = now
        self._stepped_up_at: float | None = None
        self._lost_before = False
        self._short_since: dict[float, float] = {}      # part of the rate: since when the estimate has been below it
        self._settled_at = now

    def take(self, report: Report, estimate: Estimate | None, rates: Sequence[float]) -> int:
        """The rendition to send from now on.

        Args:
            report: the newest receiver report.
            estimate: the newest REMB, if any.
            rates: bits per second of each rendition, measured or nominal.
        """
        now, self.starved_bps = report.at, None
        if report.after_silence:        # an outage, not a narrow network: what was lost in it tells nothing
            self._forget(now)
        elif self._in_trouble(report, estimate, rates):
            self._step_down(report, estimate, rates)
        elif report.fraction_lost > CLEAN:
            self._clean_since = now
        elif now - self._clean_since >= self._wait_s and self.rendition > self._best:
            self._step_up(now)
        if self._stepped_up_at is not None and now - self._stepped_up_at > TRIAL_S:
            self._stepped_up_at, self._wait_s = None, FIRST_WAIT_S
        return self.rendition

    def _in_trouble(self, report: Report, estimate: Estimate | None, rates: Sequence[float]) -> bool:
        lost_again = self._lost_before and report.fraction_lost > LOST
        self._lost_before = report.fraction_lost > LOST
        congested = report.queued_s > QUEUED_S or report.fraction_lost > CLEAN
        recent = estimate is not None and report.at - estimate.at <= FRESH_S and report.at - self._settled_at >= SETTLING_S
        believed = congested and recent
        short = False
        for part, seconds in REMB_SHORT:
            if estimate is None or not believed or estimate.bps >= part * rates[self.rendition]:
                self._short_since.pop(part, None)
            else:
                short = short or report.at - self._short_since.setdefault(part, report.at) >= seconds
        return report.fraction_lost > LOST_BADLY or lost_again or short

    def _step_down(self, report: Report, estimate: Estimate | None, rates: Sequence[float]) -> None:
        """To the best rendition that what comes through would carry, at least one step."""
        now = report.at
        self._forget(now)
        if self._stepped_up_at is not None:
            self._wait_s = min(2 * self._wait_s, LONGEST_WAIT_S)
            self._stepped_up_at = None
        carried = (1 - report.fraction_lost) * rates[self.rendition]
        if estimate is not None and now - estimate.at <= FRESH_S:
            carried = min(carried, estimate.bps)
        if self.rendition >= self._lowest:
            self.starved_bps = carried
            return
        self.rendition += 1
        while self.rendition < self._lowest and rates[self.rendition] > USABLE * carried:
            self.rendition += 1
        self.steps_down += 1

    def _step_up(self, now: float) -> None:
        self.rendition -= 1
        self.steps_up += 1
        self._stepped_up_at = now
        self._forget(now)

    def _forget(self, now: float) -> None:
        """What was heard before says nothing of what comes now."""
        self._clean_since = self._settled_at = now
        self._lost_before = False
        self._short_since.clear()

"""What one viewer's receiver reports about one track (RTCP), kept for adaptation and for the crew's eyes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

SILENT_S = 2.0      # browsers report every second
RTT_SMOOTHING = 0.85


@dataclass(frozen=True, slots=True)
class Report:
    """A receiver report. `fraction_lost` is since the last one, 0 to 1; `after_silence` when there was none for `SILENT_S`."""

    at: float
    fraction_lost: float
    after_silence: bool


class Reception:
    """Counters and estimates of one sent track. `heard(report)` is called for each receiver report."""

    def __init__(self) -> None:
        self.heard: Callable[[Report], None] = lambda report: None
        self.packets_sent = self.bytes_sent = 0
        self.packets_resent = self.bytes_resent = 0
        self.nacked = self.keyframe_requests = 0
        self.packets_lost = 0               # as the viewer counts: before retransmission
        self.fraction_lost = 0.0
        self.jitter = 0.0                   # in ticks of the RTP clock
        self.rtt_s: float | None = None
        self.remb_bps: int | None = None    # the viewer's own estimate of what it can receive
        self.remb_at = 0.0
        self.heard_at: float | None = None

    def report(self, now: float, fraction_lost: float, packets_lost: int, jitter: int, rtt_s: float | None) -> None:
        """Take a receiver report that came at the monotonic time `now`."""
        silent = self.heard_at is not None and now - self.heard_at > SILENT_S
        self.heard_at = now
        self.fraction_lost, self.packets_lost, self.jitter = fraction_lost, max(0, packets_lost), jitter
        if rtt_s is not None and rtt_s >= 0:
            self.rtt_s = rtt_s if self.rtt_s is None else RTT_SMOOTHING * self.rtt_s + (1 - RTT_SMOOTHING) * rtt_s
        self.heard(Report(now, fraction_lost, silent))

    def counts(self) -> Counter[str]:
        """What only ever grows, by the names of the metrics."""
        return Counter(rtp_packets_sent=self.packets_sent, rtp_bytes_sent=self.bytes_sent + self.bytes_resent,
                       rtp_packets_resent=self.packets_resent, rtp_packets_nacked=self.nacked,
                       rtp_packets_lost=self.packets_lost, keyframe_requests=self.keyframe_requests)

    def estimate(self, now: float, bps: int) -> None:
        """Take a REMB (draft-alvestrand-rmcat-remb) that came at the monotonic time `now`."""
        self.remb_bps, self.remb_at = bps, now

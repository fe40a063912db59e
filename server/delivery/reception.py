"""What one viewer's receiver reports about one track (RTCP), kept for adaptation and for the crew's eyes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

SILENT_S = 2.0      # browsers report every second,
WINDOW_S = 0.8      # and again with every NACK, on a handful of packets each: loss is told over at least this long
FEWEST_PACKETS = 20     # one lost of fewer is not more than one of so many
RTT_SMOOTHING = 0.85


@dataclass(frozen=True, slots=True)
class Report:
    """What was heard in about a second. `fraction_lost` is of the packets sent in it, 0 to 1, before retransmission;
    `after_silence` when nothing had been heard for `SILENT_S` before; `queued_s` is by how much the newest round trip was longer
    than the shortest there ever was."""

    at: float
    fraction_lost: float
    after_silence: bool
    queued_s: float = 0.0


@dataclass(frozen=True, slots=True)
class _Window:
    """Where the counters stood when it began."""

    began_at: float
    packets_lost: int
    highest_sequence: int


class Reception:
    """Counters and estimates of one sent track. `heard(report)` is called about once a second."""

    def __init__(self) -> None:
        self.heard: Callable[[Report], None] = lambda report: None
        self.packets_sent = self.bytes_sent = 0
        self.packets_resent = self.bytes_resent = 0
        self.nacked = self.keyframe_requests = 0
        self.packets_lost = 0               # as the viewer counts: before retransmission
        self.fraction_lost = 0.0
        self.rtt_s: float | None = None
        self._newest_rtt_s, self._least_rtt_s = 0.0, float("inf")
        self.remb_bps: int | None = None    # the viewer's own estimate of what it can receive
        self.remb_at = 0.0
        self.heard_at: float | None = None
        self._window: _Window | None = None

    def report(self, now: float, packets_lost: int, highest_sequence: int, rtt_s: float | None) -> None:
        """Take a receiver report (RFC 3550, 6.4.2) that came at the monotonic time `now`."""
        silent = self.heard_at is not None and now - self.heard_at > SILENT_S
        self.heard_at, self.packets_lost = now, max(0, packets_lost)
        if rtt_s is not None and rtt_s >= 0:
            self._newest_rtt_s, self._least_rtt_s = rtt_s, min(rtt_s, self._least_rtt_s)
            self.rtt_s = rtt_s if self.rtt_s is None else RTT_SMOOTHING * self.rtt_s + (1 - RTT_SMOOTHING) * rtt_s
        if self._window is None:
            self._window = _Window(now, packets_lost, highest_sequence)
        elif silent or now - self._window.began_at >= WINDOW_S:
            sent = (highest_sequence - self._window.highest_sequence) & 0xFFFFFFFF
            lost = packets_lost - self._window.packets_lost
            self.fraction_lost = min(max(lost / max(sent, FEWEST_PACKETS), 0.0), 1.0)
            self._window = _Window(now, packets_lost, highest_sequence)
            self.heard(Report(now, self.fraction_lost, silent, max(0.0, self._newest_rtt_s - self._least_rtt_s)))

    def counts(self) -> Counter[str]:
        """What only ever grows, by the names of the metrics."""
        return Counter(rtp_packets_sent=self.packets_sent, rtp_bytes_sent=self.bytes_sent + self.bytes_resent,
                       rtp_packets_resent=self.packets_resent, rtp_packets_nacked=self.nacked,
                       rtp_packets_lost=self.packets_lost, keyframe_requests=self.keyframe_requests)

    def estimate(self, now: float, bps: int) -> None:
        """Take a REMB (draft-alvestrand-rmcat-remb) that came at the monotonic time `now`."""
        self.remb_bps, self.remb_at = bps, now

"""The bitrate of the smallest rendition, for networks that do not even carry that one.

Its encoder is shared, so it follows the viewer who has it hardest; that is why only the smallest rendition is squeezed. Each change
is a new encoder and a keyframe, so there are few: down when somebody is in trouble, up in steps when nobody has been for a while.
"""

from __future__ import annotations

from collections.abc import Callable

FLOOR_SHARE = 0.2           # of the nominal bitrate; below that a panorama is mush
USABLE = 0.8                # of what comes through
LEAST_CHANGE = 0.9
PAUSE_S = 2.0               # between two changes downwards: the next report must be about the last one
QUIET_S = 10.0              # without trouble, then
STEP_UP = 1.25


class Squeeze:
    """`set_bps` is told the bitrate to encode with, None for the nominal one."""

    def __init__(self, set_bps: Callable[[int | None], None]) -> None:
        self.bps: int | None = None     # None: the nominal one
        self._viewers = 0
        self._set_bps = set_bps
        self._changed_at = -1e9
        self._trouble_at = -1e9

    def joined(self) -> None:
        """A viewer begins to be sent the rendition."""
        self._viewers += 1

    def left(self) -> None:
        """A viewer is sent it no more. Without any there is nobody to be squeezed for: an output takes what it gets."""
        self._viewers -= 1
        if self._viewers == 0 and self.bps is not None:
            self._change(self._changed_at, None)

    def trouble(self, now: float, carried_bps: float, nominal_bps: float) -> None:
        """A viewer of the rendition receives only so much of it."""
        self._trouble_at = now
        wanted = max(FLOOR_SHARE * nominal_bps, USABLE * carried_bps)
        if now - self._changed_at >= PAUSE_S and wanted < LEAST_CHANGE * (self.bps or nominal_bps):
            self._change(now, round(wanted))

    def quiet(self, now: float, nominal_bps: float) -> None:
        """A viewer of the rendition reports that all is well."""
        if self.bps is not None and now - max(self._trouble_at, self._changed_at) >= QUIET_S:
            wider = round(STEP_UP * self.bps)
            self._change(now, wider if wider < nominal_bps else None)

    def _change(self, now: float, bps: int | None) -> None:
        self.bps, self._changed_at = bps, now
        self._set_bps(bps)

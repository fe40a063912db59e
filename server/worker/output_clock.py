"""Source timestamps onto one monotonic clock for all tracks of a stream, because sources restart, wrap and jump.

The pictures lead: by their arrival the source's time is tied to the stream's, again whenever it has jumped. Sound is put on the
stream's clock by the tie that the pictures have at that moment, so that whatever the source's time does, the two move together.
"""

from __future__ import annotations

CLOCK_RATE = 90_000
SOUND_RATE = 48_000
MAX_DRIFT_S = 0.5           # beyond this from the arrival time, source timestamps are taken to have jumped
MAX_SOUND_DRIFT_S = 2.0     # of sound from the pictures that arrive with it: containers interleave in lumps of up to a second
MIN_STEP = 90               # ticks between two frames: 1 ms


class OutputClock:
    """Moments are seconds on the stream's clock. Follows the source's own spacing while it is plausible, arrival times otherwise.

    `new_source`, `moment` and `sound_moment` are called by the thread that reads the source, `ticks` by the one that renders.
    """

    def __init__(self, first_timestamp: int) -> None:
        self._first = first_timestamp
        self._last = first_timestamp - MIN_STEP
        self._start: float | None = None
        self._offset: float | None = None   # source seconds to moments
        self._tied = False                  # by a picture of the present source
        self._lead = 0.0                    # of the newest picture's moment over its arrival
        self.discontinuities = 0

    def new_source(self) -> None:
        """Source time begins anew: sound has no moment before the first picture has."""
        self._tied = False

    def moment(self, pts: float | None, arrived_at: float) -> float:
        """Of a picture with that source time (seconds, or None) that arrived at that monotonic time."""
        arrival = self._arrival(arrived_at)
        if pts is None:
            return arrival
        if self._offset is None or abs(pts + self._offset - arrival) > MAX_DRIFT_S:
            self.discontinuities += self._offset is not None
            self._offset = arrival - pts
        self._tied = True
        self._lead = pts + self._offset - arrival
        return pts + self._offset

    def sound_moment(self, pts: float | None, arrived_at: float) -> float | None:
        """Of sound with that source time; None while no picture ties it to the clock, or when it cannot belong to the pictures."""
        if pts is None or self._offset is None or not self._tied:
            return None
        moment = pts + self._offset
        return moment if abs(moment - self._lead - self._arrival(arrived_at)) <= MAX_SOUND_DRIFT_S else None

    def due_at(self, moment: float) -> float:
        """When a picture of that moment arrives, as a monotonic time, by the newest one that has."""
        return (self._start or 0.0) + moment - self._lead

    def ticks(self, moment: float) -> int:
        """90 kHz ticks for a frame, strictly increasing from call to call."""
        self._last = max(self._first + round(moment * CLOCK_RATE), self._last + MIN_STEP)
        return self._last

    def sound_ticks(self, moment: float) -> int:
        """48 kHz ticks of the same clock."""
        return round((self._first / CLOCK_RATE + moment) * SOUND_RATE)

    def _arrival(self, arrived_at: float) -> float:
        if self._start is None:
            self._start = arrived_at
        return arrived_at - self._start

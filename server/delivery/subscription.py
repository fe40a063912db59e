"""The feeds of one viewer: a picture that changes its rendition as the network allows, and the sound."""

from __future__ import annotations

import asyncio
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from server.delivery.adaptation import Adaptation, Estimate
from server.delivery.fanout import EncodedFrame, Taker
from server.delivery.reception import Reception, Report
from server.delivery.squeeze import Squeeze
from server.delivery.tracks import Tracks, video_track
from server.renditions import AUDIO

FLOWING_S = 2.0     # sound that has been silent for longer has ended


@dataclass(frozen=True, slots=True)
class Choice:
    """What a viewer asked for: renditions by number, the best first. One number twice: that one, whatever happens."""

    best: int
    lowest: int


class PictureFeed:
    """Joins a track when frames are first asked for, once the viewer is connected: no queue fills before.

    A switch of the rendition asks the new track for a keyframe and goes on with the old one until it is there.
    """

    def __init__(self, tracks: Tracks, names: Sequence[str], codec: str, choice: Choice,
                 delivered: Callable[[float], None]) -> None:
        """`names` of the renditions, best first; `delivered` is told, per frame, the seconds since its source frame was decoded."""
        self.codec = codec
        self.sound: SoundFeed | None = None     # of the same viewer
        self.clock = tracks.clock
        self.reception = Reception()
        self.reception.heard = self._adapt
        self.adaptation = Adaptation(choice.best, choice.lowest, time.monotonic())
        self._names = names
        self._tracks = tracks
        self._delivered = delivered
        self._filled = asyncio.Event()
        self._rendition = choice.best       # of the taker
        self._taker: Taker | None = None
        self._next: Taker | None = None     # of the rendition that adaptation has chosen
        self._last_ticks = -1
        self._closed = False

    @property
    def at_once(self) -> bool:
        return self.sound is None or not self.sound.flowing

    @property
    def rendition(self) -> str:
        """What is being sent."""
        return self._names[self._rendition]

    def counts(self) -> Counter[str]:
        counts = self.reception.counts()
        counts.update(rendition_steps_down=self.adaptation.steps_down, rendition_steps_up=self.adaptation.steps_up)
        return counts

    def describe(self) -> dict[str, Any]:
        """What the crew sees of this viewer's reception; rates in bits per second."""
        now, reception = time.monotonic(), self.reception
        rate = self._tracks.fanout(self._track(self._rendition)).rate.bps(now)
        return {
            "rendition": self.rendition, "codec": self.codec, "bitrate_bps": None if rate is None else round(rate),
            "estimate_bps": reception.remb_bps, "fraction_lost": round(reception.fraction_lost, 4),
            "rtt_ms": None if reception.rtt_s is None else round(1e3 * reception.rtt_s, 1),
            "dropped": self._taker.dropped if self._taker else 0, **self.counts(),
        }

    async def next_frame(self) -> EncodedFrame:
        if self._taker is None and not self._closed:
            self._taker = self._join(self._rendition)
            self._join_squeeze()
            self._tracks.viewer_joined(self)
        while True:
            frame = self._ready()
            if frame is not None:
                break
            self._filled.clear()
            await self._filled.wait()
        self._delivered(time.monotonic() - frame.decoded_at)
        self._last_ticks = frame.timestamp
        return frame

    def _ready(self) -> EncodedFrame | None:
        """The frame to send now, if there is one; takes the switch when the new rendition's keyframe has come."""
        assert self._taker is not None
        old = self._taker.head
        new = self._next.head if self._next is not None else None
        if new is not None and (old is None or old.timestamp >= new.timestamp):
            self._switch()
            old = new
        if old is None:
            return None
        frame = self._taker.take()
        # Where the new rendition's encoder is behind, its picture has just been sent in the old one; the next ones need it all the
        # same.
        return frame if frame.timestamp > self._last_ticks else frame.moved_to(self._last_ticks + 1)

    def _switch(self) -> None:
        assert self._taker is not None
        assert self._next is not None
        self._leave(self._rendition, self._taker)
        self._leave_squeeze()
        self._taker, self._next = self._next, None
        self._rendition = self.adaptation.rendition
        self._join_squeeze()

    def _adapt(self, report: Report) -> None:
        if self._closed:
            return      # a report that came while the connection was being closed
        before = self.adaptation.rendition
        reception = self.reception
        estimate = None if reception.remb_bps is None else Estimate(reception.remb_bps, reception.remb_at)
        if report.after_silence:
            self.request_keyframe()     # whatever the viewer has is broken
        rates = self._tracks.rates([self._track(number) for number in range(len(self._names))])
        after = self.adaptation.take(report, estimate, rates)
        self._adapt_lowest(report)
        if after == before or self._taker is None:
            return
        if self._next is not None:
            self._leave(before, self._next)
            self._next = None
        if after != self._rendition:
            self._next = self._join(after)

    def _adapt_lowest(self, report: Report) -> None:
        squeeze = self._squeeze()
        if squeeze is None:
            return
        nominal = self._tracks.nominal_bps.get(self._track(self._rendition), 0.0)
        if self.adaptation.starved_bps is not None:
            squeeze.trouble(report.at, self.adaptation.starved_bps, nominal)
        else:
            squeeze.quiet(report.at, nominal)

    def _squeeze(self) -> Squeeze | None:
        """Of the rendition that is being sent, if that is the smallest of several."""
        smallest = len(self._names) - 1
        return self._tracks.squeeze(self._track(smallest)) if self._rendition == smallest > 0 else None

    def _join_squeeze(self) -> None:
        if (squeeze := self._squeeze()) is not None:
            squeeze.joined()

    def _leave_squeeze(self) -> None:
        if (squeeze := self._squeeze()) is not None:
            squeeze.left()

    def _join(self, rendition: int) -> Taker:
        return self._tracks.fanout(self._track(rendition)).join(self._filled)

    def _leave(self, rendition: int, taker: Taker) -> None:
        self._tracks.fanout(self._track(rendition)).leave(taker)

    def _track(self, rendition: int) -> str:
        return video_track(self._names[rendition], self.codec)

    def request_keyframe(self) -> None:
        self._tracks.fanout(self._track(self._rendition)).request_keyframe()

    def close(self) -> None:
        if self._closed:
            return
        self._closed = True
        if self._next is not None:
            self._leave(self.adaptation.rendition, self._next)
        if self._taker is not None:
            self._leave(self._rendition, self._taker)
            self._leave_squeeze()
            self._tracks.viewer_left(self)


class SoundFeed:
    """The stream's sound, for as long as there is any."""

    codec = "opus"
    at_once = False

    def __init__(self, tracks: Tracks) -> None:
        self.clock = tracks.clock
        self.reception = Reception()
        self._fanout = tracks.fanout(AUDIO)
        self._taker: Taker | None = None
        self._newest_at = -1e9

    @property
    def flowing(self) -> bool:
        """Something has come lately."""
        return time.monotonic() - self._newest_at < FLOWING_S

    async def next_frame(self) -> EncodedFrame:
        if self._taker is None:
            self._taker = self._fanout.join()
        frame = await self._taker.next_frame()
        self._newest_at = time.monotonic()
        return frame

    def request_keyframe(self) -> None:
        """Every packet of sound can be understood without the others."""

    def close(self) -> None:
        if self._taker is not None:
            self._fanout.leave(self._taker)

"""The encoded tracks of one stream: each rendition in each codec, and the sound. One is encoded while somebody takes it."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from typing import Protocol

from server.delivery.fanout import EncodedFrame, FanOut
from server.delivery.squeeze import Squeeze
from server.delivery.stream_clock import VIDEO_CLOCK_HZ, StreamClock
from server.renditions import AUDIO


def video_track(rendition: str, codec: str) -> str:
    """The name of a track in messages: `full/h264`, `low/vp8`; the sound is `audio/opus`."""
    return f"{rendition}/{codec}"


class Viewer(Protocol):
    """Somebody who watches; other takers, recordings for instance, are none."""

    def counts(self) -> Counter[str]:
        """What it has been sent and has asked for, by the names of the metrics."""


class Tracks:
    """Owner of a stream's fan-outs. `demand_changed` is called when a track gets its first taker or loses its last one,
    and when the number of viewers changes."""

    def __init__(self, *, request_keyframe: Callable[[str], None], demand_changed: Callable[[], None],
                 set_bitrate: Callable[[str, int | None], None] = lambda track, bps: None) -> None:
        self._request_keyframe = request_keyframe
        self._demand_changed = demand_changed
        self._set_bitrate = set_bitrate
        self._fanouts: dict[str, FanOut] = {}
        self._squeezes: dict[str, Squeeze] = {}
        self._viewers: set[Viewer] = set()
        self._counted: Counter[str] = Counter()     # of viewers that have left
        self.clock = StreamClock()
        self.nominal_bps: dict[str, float] = {}     # of each track, as the worker sets its encoders

    def fanout(self, track: str) -> FanOut:
        if track not in self._fanouts:
            self._fanouts[track] = FanOut(request_keyframe=partial(self._keyframe, track), takers_changed=self._demand_changed,
                                          keyframes=track != AUDIO)
        return self._fanouts[track]

    def squeeze(self, track: str) -> Squeeze:
        """What bends the bitrate of the track, which is of the smallest rendition."""
        if track not in self._squeezes:
            self._squeezes[track] = Squeeze(partial(self._set_bitrate, track))
        return self._squeezes[track]

    def squeezed(self) -> dict[str, int]:
        """Tracks whose bitrate is not the nominal one now."""
        return {track: squeeze.bps for track, squeeze in self._squeezes.items() if squeeze.bps is not None}

    @property
    def wanted(self) -> list[str]:
        """Names of the tracks that somebody takes."""
        return sorted(track for track, fanout in self._fanouts.items() if len(fanout))

    @property
    def delivered(self) -> int:
        """Frames handed to takers, of all tracks but the sound."""
        return sum(fanout.delivered for track, fanout in self._fanouts.items() if track != AUDIO)

    @property
    def dropped(self) -> int:
        """Frames that slow takers lost, of all tracks but the sound."""
        return sum(fanout.dropped for track, fanout in self._fanouts.items() if track != AUDIO)

    def rates(self, tracks: Sequence[str]) -> list[float]:
        """Bits per second of each: measured where it is encoded now, else nominal, in proportion to what is measured of another.

        A quiet picture takes far less than its nominal bitrate, in every rendition alike.
        """
        now = time.monotonic()
        nominal = [self.nominal_bps.get(track, 0.0) for track in tracks]
        measured = [self.fanout(track).rate.bps(now) for track in tracks]
        used = max((bps / most for bps, most in zip(measured, nominal, strict=True) if bps is not None and most), default=1.0)
        return [most * used if bps is None else bps for bps, most in zip(measured, nominal, strict=True)]

    def load(self) -> list[tuple[str, int, float]]:
        """Of each track that anybody has ever taken: its name, its takers, bits per second."""
        now = time.monotonic()
        return [(track, len(fanout), fanout.rate.bps(now) or 0.0) for track, fanout in self._fanouts.items()]

    def publish(self, track: str, frame: EncodedFrame) -> None:
        if track != AUDIO:
            self.clock.start(frame.timestamp, VIDEO_CLOCK_HZ, frame.decoded_at)
        if track in self._fanouts:      # nobody else can want it
            self._fanouts[track].publish(frame)

    @property
    def viewers(self) -> int:
        return len(self._viewers)

    def viewer_joined(self, viewer: Viewer) -> None:
        self._viewers.add(viewer)
        self._demand_changed()

    def viewer_left(self, viewer: Viewer) -> None:
        self._viewers.remove(viewer)
        self._counted.update(viewer.counts())
        self._demand_changed()

    def counts(self) -> Counter[str]:
        """What all viewers there ever were have been sent and have asked for."""
        total = Counter(self._counted)
        for viewer in self._viewers:
            total.update(viewer.counts())       # `+` would leave out what is zero
        return total

    def encoders_replaced(self) -> None:
        """The packets that follow come from other encoders: every taker goes on at a keyframe."""
        for fanout in self._fanouts.values():
            fanout.encoder_replaced()

    def _keyframe(self, track: str) -> None:
        if track != AUDIO:
            self._request_keyframe(track)
